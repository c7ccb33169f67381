"""PyTorch's files are read without PyTorch, and nothing that they ask for is done."""

import argparse
import pathlib
import pickle
import pickletools
import sys
import zipfile

import numpy as np
import pytest
from helpers.pickles import Raw, Shell, Writer, named, save
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from arm5dof.errors import UserError
from arm5dof.vision import images
from arm5dof.vision.detectors.yolov5.model import YOLOv5
from arm5dof.vision.detectors.yolov5.pt_reader import OPCODES, read_pt


def test_values_and_tensors_come_back(tmp_path):
    numbers = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
    writer = Writer()
    saved = {
        "a": [1, -2.5, None, True, "text", (1, 2)],
        "whole": numbers,
        "half": numbers.astype(np.float16).transpose(2, 0, 1),
        "part": writer.tensor(numbers, 5, (2, 2), (12, 1)),
        "scalar": np.array(7, np.int64),
        "empty": np.zeros((0, 3)),
    }
    loaded = read_pt(save(tmp_path / "x.pt", saved, writer))
    assert loaded["a"] == [1, -2.5, None, True, "text", (1, 2)]
    for name in ("whole", "scalar", "empty"):
        np.testing.assert_array_equal(loaded[name].array, saved[name])
        assert loaded[name].array.dtype == saved[name].dtype
    # The storage of a transposed array was written in its own order, and its strides say so.
    assert loaded["half"].array.shape == (4, 2, 3) and loaded["half"].array.dtype == np.float16
    np.testing.assert_array_equal(loaded["part"].array, [[5, 6], [17, 18]])


def test_modules_are_shells(tmp_path):
    weight = np.ones((2, 3), np.float32)
    conv = Shell("torch.nn.modules.conv.Conv2d", _parameters={"weight": weight}, _buffers={}, _modules={}, groups=1)
    model = Shell("models.common.Conv", _parameters={}, _buffers={}, _modules={"conv": conv}, i=4)
    loaded = read_pt(save(tmp_path / "x.pt", {"model": model}))["model"]
    assert loaded.kind == "models.common.Conv" and loaded.get("i") == 4 and loaded.has("conv")
    assert [child.kind for child in loaded.children()] == ["torch.nn.modules.conv.Conv2d"]
    np.testing.assert_array_equal(loaded.get("conv").get("weight"), weight)
    with pytest.raises(UserError, match="no 'bias'"):
        loaded.get("conv").get("bias")
    assert "models" not in sys.modules and "torch" not in sys.modules


def test_the_published_weights(test_data):
    saved = read_pt(test_data / "vision" / "models" / "yolov5n.pt")
    model = saved["model"]
    assert model.kind == "models.yolo.Model" and len(model.get("names")) == 80
    first = model.get("model").children()[0].get("conv").get("weight")
    assert first.shape == (16, 3, 6, 6) and first.dtype == np.float16 and np.isfinite(first).all()

    def count(module):
        own = sum(p.array.size for p in module.get("_parameters").values() if p is not None)
        return own + sum(map(count, module.children()))

    assert count(model) == 1_872_157  # What the model's page states: 1.9 million.
    assert "torch" not in sys.modules


def call(module, name, *arguments):
    return Raw(named(module, name) + Writer().write(tuple(arguments)) + b"R")


def attacks(command):
    """Pickles that a plain unpickler would run or choke on."""
    system = named("os", "system")
    conv = named("models.common", "Conv")
    text = Writer().write(command)
    yield "os.system", call("os", "system", command)
    yield "posix.system", call("posix", "system", command)
    yield "eval", call("__builtin__", "eval", f"__import__('os').system({command!r})")
    yield "builtins.eval", call("builtins", "eval", f"__import__('os').system({command!r})")
    yield "getattr", call("builtins", "getattr", Raw(conv), "__init__")
    yield "import", call("importlib", "import_module", "os")
    yield "inside a value", [1, {"model": (2, call("subprocess", "call", command))}]
    yield "as a state", Shell("models.common.Conv", weight=call("os", "system", command))
    yield "shell called", Raw(conv + Writer().write((command,)) + b"R")
    yield "shell made with arguments", Raw(conv + Writer().write((command,)) + b"\x81")
    yield "class changed", Raw(conv + b"N}" + Writer().write("__setstate__") + system + b"s\x86b")
    inert = b"N}" + Writer().write("__setstate__") + named("collections", "OrderedDict") + b"s\x86b"
    yield "class changed to what is allowed", Raw(conv + inert)
    yield "storage class changed", Raw(named("torch", "FloatStorage") + inert)
    yield "attributes not a dict", Raw(conv + b")\x81" + b"N}\x86b")
    yield "storage made", Raw(named("torch", "FloatStorage") + b")R")
    yield "parameter of a function", Raw(named("torch._utils", "_rebuild_parameter") + b"(" + system + b"tR")
    yield "parameter of no tensor", call("torch._utils", "_rebuild_parameter", [1])
    yield "tensor of no storage", call("torch._utils", "_rebuild_tensor_v2", [0] * 9, 0, (3,), (1,))
    yield "dotted name", Raw(named("models.common", "Conv.__init__.__globals__"))
    yield "hidden module", Raw(named("models", "os"))
    yield "old instance", Raw(b"(" + text + b"ios\nsystem\n")
    yield "old object", Raw(b"(" + system + text + b"o")
    yield "newer name", Raw(b"\x8c\x02os\x8c\x06system\x93" + b"(" + text + b"tR")
    yield "extension", Raw(b"\x82\x01")
    yield "memo of terabytes", Raw(b"Nr\xff\xff\xff\x7f")
    yield "text of gigabytes", Raw(b"X\xff\xff\xff\x7fabc")
    yield "tuples a million deep as a key", Raw(b"}N" + b"\x85" * 10**6 + b"Ns")
    yield "other persistent object", Raw(Writer().write(("module", Raw(conv), "0", "cpu", 1)) + b"Q")
    yield "path as a key", Raw(Writer().write(("storage", named("torch", "FloatStorage"), "../x", "cpu", 1)) + b"Q")
    yield "missing storage", Raw(Writer().write(("storage", named("torch", "FloatStorage"), "9", "cpu", 1)) + b"Q")
    yield "empty", Raw(b"")
    yield "stack underflow", Raw(b"tR")


@pytest.mark.parametrize("name", [name for name, _ in attacks("")])
def test_malicious_pickles_run_nothing(tmp_path, name):
    marker = tmp_path / "was here"
    attack = dict(attacks(f"touch '{marker}'"))[name]
    with pytest.raises(UserError, match=r"x\.pt is (refused|damaged)"):
        read_pt(save(tmp_path / "x.pt", attack))
    assert not marker.exists()


def test_those_pickles_would_have_run(tmp_path):
    marker = tmp_path / "was here"
    for name in ("os.system", "eval", "inside a value", "old instance", "old object"):
        attack = dict(attacks(f"touch '{marker}'"))[name]
        attack = call("subprocess", "getoutput", f"touch '{marker}'") if name == "inside a value" else attack
        pickle.loads(b"\x80\x02" + Writer().write(attack) + b".")
        assert marker.exists(), name
        marker.unlink()


RECORDS = {
    "scalar": np.float64(0.7),
    "array": np.arange(3.0),
    "pure path": pathlib.PurePosixPath("runs/mine.yaml"),
    "path": pathlib.Path("runs/mine.yaml"),
    "options": argparse.Namespace(epochs=300, data=pathlib.Path("mine.yaml")),
}


@pytest.mark.parametrize("numpy", [b"numpy.core.", b"numpy._core."])
@pytest.mark.parametrize("name", RECORDS)
def test_harmless_shells_are_all_that_is_left_of_training_records(tmp_path, name, numpy):
    """As Python's own pickle writes them, in the protocol that PyTorch uses, whatever wrote the file."""
    text = pickle.dumps(RECORDS[name], 2)[2:-1].replace(b"numpy._core.", numpy)
    loaded = read_pt(save(tmp_path / "x.pt", {"best_fitness": Raw(text), "epoch": 3}))
    assert loaded["epoch"] == 3 and type(loaded["best_fitness"]).__module__ == read_pt.__module__
    if name == "path":
        text = text.replace(b"PosixPath", b"WindowsPath").replace(b"pathlib\n", b"pathlib._local\n")
        assert read_pt(save(tmp_path / "x.pt", {"best_fitness": Raw(text), "epoch": 3}))["epoch"] == 3


@pytest.mark.parametrize("name", ["posix", "windows", "numpy2_scalar", "numpy2_array"])
def test_files_with_records_of_todays_training(test_data, name):
    folder = test_data / "faults/15-yolov5-pt"
    detector = YOLOv5(folder / f"{name}.pt", size=64)
    assert detector.class_names == ("cup", "nut") and len(detector(images.read(folder / "img.png")))


@pytest.mark.parametrize(
    "offset, size, stride, numel",
    [
        (0, (7,), (1,), None),
        (1, (6,), (1,), None),
        (0, (2, 3), (4, 1), None),
        (-1, (2,), (1,), None),
        (0, (2,), (-1,), None),
        (0, (-2,), (1,), None),
        (0, (10**6, 10**6), (0, 0), None),
        (0, (2,), (2**62,), None),
        (0, (2, 3), (1,), None),
        (0, (True,), (1,), None),
        (0, "ab", (1, 1), None),
        (0, (1,) * 9, (1,) * 9, None),
        (0, (6,), (1,), 7),
        (0, (6,), (1,), 5),
        (0, (6,), (1,), 2**50),
    ],
)
def test_tensors_stay_inside_their_storage(tmp_path, offset, size, stride, numel):
    writer = Writer()
    tensor = writer.tensor(np.zeros(6, np.float32), offset, size, stride, numel)
    with pytest.raises(UserError, match=r"is (refused|damaged)"):
        read_pt(save(tmp_path / "x.pt", tensor, writer))


def test_one_storage_has_one_type(tmp_path):
    writer = Writer()
    single = writer.tensor(np.zeros(8, np.float32), 0, (8,), (1,))
    writer.records.clear()
    double = writer.tensor(np.zeros(8, np.float64), 0, (8,), (1,))
    with pytest.raises(UserError, match=r"size that the file states|too large|damaged"):
        read_pt(save(tmp_path / "x.pt", [double, single], writer))


def test_foreign_files_are_one_clear_line(tmp_path):
    whole = save(tmp_path / "whole.pt", {"weight": np.ones(1000)}).read_bytes()
    (tmp_path / "cut.pt").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.pt").write_text("hello")
    (tmp_path / "empty.pt").write_bytes(b"")
    (tmp_path / "bare.pt").write_bytes(pickle.dumps([1]))
    with zipfile.ZipFile(tmp_path / "other.pt", "w") as archive:
        archive.writestr("word/document.xml", "<x/>")
    save(tmp_path / "squeezed.pt", [0] * 1000, compression=zipfile.ZIP_DEFLATED)
    for name in ("cut", "text", "empty", "bare", "other", "squeezed", "nowhere"):
        with pytest.raises(UserError, match=f"{name}.pt") as raised:
            read_pt(tmp_path / f"{name}.pt")
        assert "\n" not in str(raised.value)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=150)
@given(at=st.integers(0, 10**6), byte=st.integers(0, 255), cut=st.booleans())
def test_any_damage_is_a_user_error_or_harmless(tmp_path, at, byte, cut):
    conv = Shell("models.common.Conv", _parameters={"weight": np.ones(4, np.float32)}, _buffers={}, _modules={})
    content = bytearray(save(tmp_path / "x.pt", {"model": conv, "names": ["a"]}).read_bytes())
    at %= len(content)
    if cut:
        content = content[:at]
    else:
        content[at] = byte
    (tmp_path / "x.pt").write_bytes(content)
    try:
        read_pt(tmp_path / "x.pt")
    except UserError as error:
        assert "x.pt" in str(error)


def test_the_opcodes_allowed_are_pythons_own():
    assert {opcode.name for opcode in pickletools.opcodes} > OPCODES
