"""The tabletop detector's weights survive their file, and what is no such file is refused."""

import io
import zipfile

import jax
import numpy as np
import pytest
from helpers.tabletop_weights import NETWORKS, weights_of, zeros

from arm5dof.errors import UserError
from arm5dof.vision.detectors.tabletop.detector import TabletopDetector
from arm5dof.vision.detectors.tabletop.weights import load_weights, save_weights


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """A file of weights."""
    path = tmp_path_factory.mktemp("weights") / "good.npz"
    save_weights(path, weights_of(16, 3.0, 2.0), ("cube", "ball", "ring"))
    return path


def test_weights_survive_their_file(tmp_path):
    random = np.random.default_rng(0)
    folded = jax.tree.map(lambda x: random.normal(0, 0.1, x.shape), {name: zeros(name) for name in NETWORKS})
    save_weights(tmp_path / "w.npz", folded, ("a", "b", "c"))
    save_weights(tmp_path / "again.npz", folded, ("a", "b", "c"))
    assert (tmp_path / "w.npz").read_bytes() == (tmp_path / "again.npz").read_bytes()
    read, names = load_weights(tmp_path / "w.npz")
    assert names == ("a", "b", "c")
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-6), read, folded)


def damaged(kind, path, tmp_path):
    whole = path.read_bytes()
    with np.load(path) as archive:
        arrays = dict(archive)
    out = tmp_path / "bad.npz"
    content = io.BytesIO()
    match kind:
        case "cut":
            content.write(whole[: len(whole) // 2])
        case "empty":
            pass
        case "text":
            content.write(b"weights")
        case "flipped":
            with zipfile.ZipFile(path) as archive:
                names = sorted(archive.infolist(), key=lambda i: i.header_offset)
            middle = (names[3].header_offset + names[4].header_offset) // 2
            content.write(whole[:middle] + bytes(b ^ 255 for b in whole[middle : middle + 9]) + whole[middle + 9 :])
        case "foreign":
            np.savez(content, weights=np.zeros(3))
        case "array":
            np.save(content, np.zeros(3))
        case "header":
            array = io.BytesIO()
            np.save(array, np.zeros(3))
            with zipfile.ZipFile(content, "w") as archive:
                archive.writestr("class_names.npy", array.getvalue().replace(b"}", b"("))
        case "huge":
            array = io.BytesIO()
            np.save(array, np.zeros(3))
            with zipfile.ZipFile(content, "w") as archive:
                archive.writestr("class_names.npy", array.getvalue().replace(b"(3,)", b"(9999999999999,)"))
        case "missing":
            arrays.pop("refiner/logits/bias")
            np.savez(content, **arrays)
        case "shape":
            np.savez(content, **{**arrays, "refiner/logits/bias": np.zeros(4)})
        case "classes":
            np.savez(content, **{**arrays, "class_names": np.array(["one"])})
        case "not finite":
            np.savez(content, **{**arrays, "refiner/logits/bias": np.full(3, np.nan)})
        case "text for numbers":
            np.savez(content, **{**arrays, "refiner/logits/bias": np.array(["a", "b", "c"])})
        case "pickle":
            np.savez(content, **{**arrays, "refiner/logits/bias": np.array([Bomb()], object)})
    out.write_bytes(content.getvalue())
    return out


class Bomb:
    def __reduce__(self):
        return pytest.fail, ("a pickle was executed",)


DAMAGES = ["cut", "empty", "text", "flipped", "foreign", "array", "missing", "shape", "classes", "pickle"]


@pytest.mark.parametrize("kind", [*DAMAGES, "header", "huge", "not finite", "text for numbers"])
def test_damaged_and_foreign_weights_are_refused(good, tmp_path, kind):
    with pytest.raises(UserError, match="train the tabletop detector") as error:
        TabletopDetector(damaged(kind, good, tmp_path))
    assert "\n" not in str(error.value)


def test_missing_weights_are_refused(tmp_path):
    with pytest.raises(UserError, match="train the tabletop detector"):
        TabletopDetector(tmp_path / "none.npz")
    with pytest.raises(UserError, match="confidence"):
        TabletopDetector(confidence=2)
