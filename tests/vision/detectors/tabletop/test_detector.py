"""The detector that ships: its network, what it is asked to learn, its weights' file, and a training in small."""

import io
import zipfile
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arm5dof.cli.main import main
from arm5dof.errors import UserError
from arm5dof.vision.detectors.loading import load
from arm5dof.vision.detectors.tabletop.detector import (
    PROPOSALS,
    TRUST,
    TabletopDetector,
    load_weights,
    propose,
    refine,
    save_weights,
)
from arm5dof.vision.detectors.tabletop.networks import (
    CROP,
    INNER,
    REACH,
    STRIDE,
    Proposer,
    Refiner,
    cells,
    enlarge,
    fold,
    patches,
)
from arm5dof.vision.detectors.tabletop.proposals import CONTEXT, crop, squares, to_crop, to_picture
from arm5dof.vision.detectors.tabletop.training import assignment, crops, training_set
from arm5dof.vision.detectors.tabletop.training.assignment import (
    CELLS,
    Labels,
    assign,
    generalised_overlap,
    overlap,
    proposed,
    refined,
)
from arm5dof.vision.detectors.tabletop.training.train import Learner
from arm5dof.vision.detectors.tabletop.training.training_set import WINDOW
from arm5dof.vision.objects import CLASS_NAMES
from arm5dof.vision.synthetic.samples import shots

GREY = np.full((480, 640, 3), 100, np.uint8)
SEEDS = st.integers(0, 2**32 - 1)
BACKGROUND = np.float32([[5, 5, 40, 40], [600, 440, 635, 475], [5, 440, 40, 475]])
NETWORKS = {"proposer": Proposer, "refiner": partial(Refiner, 3)}


def inputs(name, count, random=None):
    """What one of the networks takes: pictures, and for the refiner the widths of crops."""
    side = CROP if name == "refiner" else 64
    random = random or np.random.default_rng(0)
    pictures = random.integers(0, 256, (count, side, side, 3), np.uint8)
    return (pictures, random.uniform(20, 90, count).astype(np.float32)) if name == "refiner" else (pictures,)


def zeros(name):
    """Folded weights of one of the networks, all zero."""
    like = jax.eval_shape(NETWORKS[name](False).init, jax.random.key(0), *inputs(name, 1))
    return jax.tree.map(lambda x: np.zeros(x.shape, np.float32), like["params"])


def weights_of(size, likely, sure):
    """Folded weights of networks of which one says that a square thing of that size, in pixels of the reduced picture,
    lies round every cell, so likely, and the other that it is of the first class, so sure, and moves it nowhere."""
    proposer, refiner = zeros("proposer"), zeros("refiner")
    proposer["edges"]["bias"] = np.full(4, (size / 2 - REACH) / STRIDE, np.float32)
    proposer["logits"]["bias"] = np.float32([likely])
    inner = 0.5 + np.array([-1, -1, 1, 1]) / (2 * CONTEXT)
    refiner["edges"]["bias"] = np.float32((inner - INNER) / 0.2)
    refiner["logits"]["bias"] = np.float32([sure, -9, -9])
    return {"proposer": proposer, "refiner": refiner}


# The networks


def test_patches_are_a_strided_convolution():
    random = np.random.default_rng(0)
    x, kernel = random.normal(size=(2, 8, 12, 3)).astype(np.float32), random.normal(size=(4, 4, 3, 5))
    expected = jax.lax.conv_general_dilated(
        x, np.float32(kernel), (4, 4), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )
    np.testing.assert_allclose(patches(x, 4) @ np.float32(kernel.reshape(48, 5)), expected, rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(enlarge(jnp.asarray(x)), x.repeat(2, 1).repeat(2, 2))


@pytest.mark.parametrize("name", NETWORKS)
def test_folding_changes_nothing(name):
    make, random = NETWORKS[name], np.random.default_rng(0)
    given = inputs(name, 2, random)
    like = jax.eval_shape(make().init, jax.random.key(0), *given)
    variables = jax.tree.map(lambda x: random.normal(0, 0.15, x.shape).astype(np.float32), like)
    variables["batch_stats"] = jax.tree.map(lambda x: np.abs(x) + 0.5, variables["batch_stats"])
    folded = fold(variables["params"], variables["batch_stats"])
    expected = jax.jit(make().apply)(variables, *given)
    found = jax.jit(make(False).apply)({"params": folded}, *given)
    assert float(jnp.std(expected[1])) > 0.01
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-3)


def test_boxes_are_as_far_from_their_cells_as_the_network_says():
    params = zeros("proposer")
    params["edges"]["bias"] = (np.float32([4, 6, 8, 10]) - REACH) / STRIDE
    boxes, logits = jax.jit(Proposer(False).apply)({"params": params}, np.zeros((1, 64, 96, 3), np.uint8))
    assert boxes.shape == (1, 8 * 12, 4) and logits.shape == (1, 8 * 12)
    expected = [(x - 4, y - 6, x + 8, y + 10) for y in range(4, 64, 8) for x in range(4, 96, 8)]
    np.testing.assert_allclose(boxes[0], expected, atol=1e-5)


# Crops


@given(SEEDS)
def test_crops_show_what_opencv_resizes(seed):
    """A crop whose square lies on whole pixels, at a whole scale, is that part of the picture; and boxes go there and
    back."""
    random = np.random.default_rng(seed)
    picture = random.integers(0, 256, (480, 640, 3), np.uint8)
    left, top = random.integers(0, (640 - CROP, 480 - CROP))
    seen = crop(picture, np.array([left, top, CROP]))
    np.testing.assert_array_equal(seen, picture[top : top + CROP, left : left + CROP])

    low = random.uniform(0, 400, (5, 2))
    boxes = np.concatenate([low, low + random.uniform(13, 80, (5, 2))], axis=1)
    where = squares(boxes)
    np.testing.assert_allclose(where[:, 2], CONTEXT * (boxes[:, 2:] - boxes[:, :2]).max(1))
    shares = to_crop(boxes, where)
    assert (shares > 0.2).all() and (shares < 0.8).all()
    np.testing.assert_allclose((shares[:, :2] + shares[:, 2:]) / 2, 0.5)
    np.testing.assert_allclose(to_picture(shares, where), boxes)


def test_crops_go_on_beyond_the_picture_as_it_ends():
    picture = np.full((20, 30, 3), 7, np.uint8)
    assert (crop(picture, np.array([-15.0, -10.0, 60.0])) == 7).all()


# What the cells are asked to learn


def scene(random, things, rows=9):
    """Labels of some things, in rows of which some say nothing, and what the cells of a picture of 96 x 96 say."""
    middle, half = random.uniform(5, 91, (rows, 2)), random.uniform(3, 20, (rows, 2))
    boxes = np.float32(np.concatenate([middle - half, middle + half], 1))
    role = random.permutation(np.r_[np.ones(things), np.zeros(rows - things)]).astype(bool)
    hidden = role & (random.random(rows) < 0.2)
    labels = Labels(boxes, role & ~hidden, hidden)
    middles = cells(96, 96)
    predicted = np.float32(np.concatenate([middles - random.uniform(0, 25, middles.shape),
                                           middles + random.uniform(0, 25, middles.shape)], 1))  # fmt: skip
    return middles, predicted, np.float32(random.random(len(middles))), labels


assigned = jax.jit(assign)


@given(SEEDS, st.integers(0, 9))
def test_each_thing_has_some_of_the_cells_in_its_box(seed, things):
    middles, boxes, scores, labels = scene(np.random.default_rng(seed), things)
    targets = jax.device_get(assigned(middles, boxes, scores, labels))
    claimed = targets.scores > 0
    assert (targets.scores >= 0).all() and (targets.scores <= 1).all() and targets.judged[claimed].all()

    fit = np.asarray(overlap(labels.boxes[:, None], boxes))
    apart = np.asarray(overlap(labels.boxes[:, None], labels.boxes)) - np.eye(len(labels.boxes))
    for i, box in enumerate(labels.boxes):
        mine = claimed & (targets.boxes == box).all(1)
        if not labels.found[i]:
            assert not mine.any()
            continue
        assert mine.sum() <= CELLS
        reach = np.maximum(box[2:] - box[:2], assignment.SMALLEST) / 2 + 1e-3
        assert (np.abs(middles[mine] - (box[:2] + box[2:]) / 2) < reach).all()
        if mine.any():  # The best of them is asked for exactly what its box is worth.
            np.testing.assert_allclose(targets.scores[mine].max(), fit[i, mine].max(), rtol=1e-5)
        inside = (np.abs(middles - (box[:2] + box[2:]) / 2) < reach).all(1)
        if apart[i][labels.found].max(initial=0) == 0 and fit[i, inside].max() > 0.05:
            assert mine.any()


@given(SEEDS, st.integers(1, 9))
def test_the_order_of_things_does_not_matter(seed, things):
    random = np.random.default_rng(seed)
    middles, boxes, scores, labels = scene(random, things)
    order = random.permutation(len(labels.boxes))
    one = assigned(middles, boxes, scores, labels)
    other = assigned(middles, boxes, scores, Labels(*(rows[order] for rows in labels)))
    np.testing.assert_allclose(one.scores, other.scores, atol=1e-6)
    np.testing.assert_array_equal(one.judged, other.judged)


def test_hidden_things_are_no_one_s_mistake():
    """A cell in the box of one may say what it likes; the same cell is wrong where there is nothing."""
    middles = cells(96, 96)
    labels = Labels(np.float32([[20, 20, 60, 60]]), np.zeros(1, bool), np.ones(1, bool))
    boxes = np.float32(np.concatenate([middles - 10, middles + 10], 1))
    sure = np.where(((middles > 20) & (middles < 60)).all(1), 5, -20).astype(np.float32)
    assert float(proposed(boxes, sure, labels, middles).classification) < 1e-3
    assert float(proposed(boxes, sure, labels._replace(ignored=np.zeros(1, bool)), middles).classification) > 50


def test_what_the_refiner_is_asked():
    """A thing's box, and a score as high as its own box fits; of background, no score of any class, and no box."""
    wanted, close = np.float32([0.2, 0.2, 0.8, 0.8]), np.float32([0.2, 0.2, 0.8, 0.74])
    fit = 0.9
    right = np.float32([-20, np.log(fit / (1 - fit)), -20])
    parts = refined(close, right, wanted, np.int32(1))
    entropy = -fit * np.log(fit) - (1 - fit) * np.log(1 - fit)
    np.testing.assert_allclose(parts.classification, entropy, rtol=1e-5)
    np.testing.assert_allclose(parts.localisation, 1 - fit, rtol=1e-5)
    assert float(parts.closeness) > 0 and float(
        refined(wanted, right, wanted, np.int32(1)).localisation
    ) == pytest.approx(0)
    for other in (0, 2):
        assert float(refined(close, right, wanted, np.int32(other)).classification) > 10
    nothing = refined(close, np.full(3, np.float32(-20)), wanted, np.int32(-1))
    np.testing.assert_allclose(nothing, 0, atol=1e-6)


@given(SEEDS)
def test_overlaps(seed):
    """As pycocotools counts them; and the generalised overlap is less by the share of the hull that neither covers."""
    mask = pytest.importorskip("pycocotools.mask")
    random = np.random.default_rng(seed)
    a, b = (
        np.concatenate([low := random.uniform(0, 50, (6, 2)), low + random.uniform(1, 50, (6, 2))], 1) for _ in "ab"
    )
    theirs = mask.iou(*(np.concatenate([x[:, :2], x[:, 2:] - x[:, :2]], 1) for x in (a, b)), [0] * 6)
    np.testing.assert_allclose(overlap(a[:, None], b), theirs, atol=1e-5)
    for one, other, fit in zip(a, b, np.diag(theirs), strict=True):
        area = [np.prod(x[2:] - x[:2]) for x in (one, other)]
        hull = np.prod(np.maximum(one[2:], other[2:]) - np.minimum(one[:2], other[:2]))
        union = sum(area) / (1 + fit)
        assert generalised_overlap(one, other) == pytest.approx(fit - (hull - union) / hull, abs=1e-5)


# The detector


@pytest.fixture(scope="module")
def wide(tmp_path_factory):
    """A detector that finds something of the first class round every cell, 32 pixels wide."""
    path = tmp_path_factory.mktemp("weights") / "wide.npz"
    save_weights(path, weights_of(16, 3.0, 2.0), ("cube", "ball", "ring"))
    return path


@pytest.mark.parametrize("width, height, scale, left", [(640, 480, 1, 0), (1280, 960, 2, 0), (480, 640, 4 / 3, 140)])
def test_detections_are_in_the_image_s_own_pixels(tmp_path, width, height, scale, left):
    """Of a detector that finds something in every cell of the first row, 12 pixels wide."""
    save_weights(tmp_path / "narrow.npz", weights_of(6, 3.0, 2.0), ("cube", "ball", "ring"))
    found = TabletopDetector(tmp_path / "narrow.npz")(np.zeros((height, width, 3), np.uint8))
    assert found.class_names == ("cube", "ball", "ring") and set(found.class_id) == {0}
    expected = (1 + np.exp(-3)) ** -TRUST * (1 + np.exp(-2)) ** (TRUST - 1)
    np.testing.assert_allclose(found.confidence, expected, rtol=1e-3)
    assert (found.xyxy >= 0).all() and (found.xyxy <= [width, height, width, height]).all()
    whole = found.xyxy[(found.xyxy[:, 0] > 0) & (found.xyxy[:, 2] < width)] / scale
    assert len(whole) > 5
    np.testing.assert_allclose(whole[:, 2:] - whole[:, :2], 12, atol=0.1)
    middles = whole[:, :2] + 6 + [left, 0]
    np.testing.assert_allclose((middles - 8) / 16, np.round((middles - 8) / 16), atol=0.02)


def test_overlapping_boxes_are_one_thing(wide):
    detector = TabletopDetector(wide)
    proposals, likely = propose(detector._params["proposer"], GREY)
    np.testing.assert_allclose(likely, 1 / (1 + np.exp(-3)), rtol=1e-3)
    boxes = detector(GREY).xyxy
    fit = np.asarray(overlap(boxes[:, None], boxes)) - np.eye(len(boxes))
    assert 10 < len(boxes) <= len(proposals) <= PROPOSALS and fit.max() < 0.601
    assert len(TabletopDetector(wide, confidence=0.95)(GREY)) == 0
    assert len(TabletopDetector(wide, iou=0.1)(GREY)) < len(boxes)


def test_a_mirrored_look_is_a_look_in_the_mirror():
    random = np.random.default_rng(0)
    params = jax.tree.map(lambda x: random.normal(0, 0.1, x.shape), zeros("refiner"))
    picture = random.integers(0, 256, (480, 640, 3)).astype(np.uint8)
    low = random.uniform(20, 400, (5, 2))
    boxes = np.concatenate([low, low + random.uniform(10, 60, (5, 2))], axis=1)

    def mirror(boxes):
        boxes = boxes.copy()
        boxes[:, [0, 2]] = 640 - boxes[:, [2, 0]]
        return boxes

    there, logits = refine(params, picture, boxes, mirrored=True)
    mirrored, same = refine(params, np.ascontiguousarray(picture[:, ::-1]), mirror(boxes))
    # OpenCV places pixels to a thirty-second.
    np.testing.assert_allclose(there, mirror(mirrored), atol=0.2)
    np.testing.assert_allclose(logits, same, atol=0.05)


def test_a_picture_without_proposals_has_no_detections(tmp_path):
    save_weights(tmp_path / "none.npz", weights_of(16, -9.0, 2.0), ("cube", "ball", "ring"))
    assert len(TabletopDetector(tmp_path / "none.npz")(GREY)) == 0


@pytest.mark.parametrize(
    "image", [GREY[..., 0], np.dstack([GREY, GREY[..., :1]]), GREY.astype(np.uint16) * 257, GREY / 255]
)
def test_images_are_converted(wide, image):
    np.testing.assert_allclose(TabletopDetector(wide)(image).xyxy, TabletopDetector(wide)(GREY).xyxy, atol=1e-3)


@pytest.mark.parametrize(
    "image", [np.zeros((0, 4, 3), np.uint8), GREY.astype(int), np.full((4, 4), np.nan), GREY[0, 0]]
)
def test_what_is_no_image_is_refused(wide, image):
    with pytest.raises(UserError):
        TabletopDetector(wide)(image)


# Its file


def test_the_file_says_which_detector_it_is_for(wide):
    detector = load(wide, confidence=0.95)
    assert isinstance(detector, TabletopDetector) and len(detector(GREY)) == 0
    for options in ({"class_names": ["a", "b", "c"]}, {"size": 320}):
        with pytest.raises(UserError, match="are fixed"):
            load(wide, **options)


def test_careful_looks_find_no_less_and_their_boxes_fit_better():
    """In scenes of training's kind, but not among those that the weights were learnt from."""
    detectors = [load(confidence=0.1, careful=careful) for careful in (False, True)]
    fits: list[list[float]] = [[], []]
    for shot in shots(6, 3, "training", "software", 2):
        for detector, fit in zip(detectors, fits, strict=True):
            overlaps = overlap(shot.truth.xyxy[shot.truth.counts][:, None], detector(shot.picture).xyxy)
            fit += np.max(overlaps, axis=1, initial=0).tolist()
    once, thrice = np.array(fits)
    assert len(once) > 10 and np.sum(thrice > 0.5) >= np.sum(once > 0.5) > 0.9 * len(once)
    assert np.median(thrice) > np.median(once) > 0.9


def test_only_careful_looks_are_for_the_unlikely(tmp_path):
    """Between the two thresholds is 0.03."""
    save_weights(tmp_path / "weak.npz", weights_of(16, np.log(0.03 / 0.97), 2.0), ("cube", "ball", "ring"))
    quick, careful = (TabletopDetector(tmp_path / "weak.npz", 0.1, careful=careful) for careful in (False, True))
    assert len(quick(GREY)) == 0 < len(careful(GREY))


def test_only_the_tabletop_detector_can_be_careful(tmp_path):
    (tmp_path / "other.onnx").write_bytes(b"\x08")
    with pytest.raises(UserError, match="careful"):
        load(tmp_path / "other.onnx", careful=True)


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
    good = path.read_bytes()
    with np.load(path) as archive:
        arrays = dict(archive)
    out = tmp_path / "bad.npz"
    content = io.BytesIO()
    match kind:
        case "cut":
            content.write(good[: len(good) // 2])
        case "empty":
            pass
        case "text":
            content.write(b"weights")
        case "flipped":
            with zipfile.ZipFile(path) as archive:
                names = sorted(archive.infolist(), key=lambda i: i.header_offset)
            middle = (names[3].header_offset + names[4].header_offset) // 2
            content.write(good[:middle] + bytes(b ^ 255 for b in good[middle : middle + 9]) + good[middle + 9 :])
        case "foreign":
            np.savez(content, weights=np.zeros(3))
        case "array":
            np.save(content, np.zeros(3))
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


@pytest.mark.parametrize("kind", [*DAMAGES, "not finite", "text for numbers"])
def test_damaged_and_foreign_weights_are_refused(wide, tmp_path, kind):
    with pytest.raises(UserError, match="vision train") as error:
        TabletopDetector(damaged(kind, wide, tmp_path))
    assert "\n" not in str(error.value)


def test_missing_weights_are_refused(tmp_path):
    with pytest.raises(UserError, match="vision train"):
        TabletopDetector(tmp_path / "none.npz")
    with pytest.raises(UserError, match="confidence"):
        TabletopDetector(confidence=2)


def test_what_proposals_are_of():
    """Of the thing that they overlap; of background; or of what is hidden, or half beside something, and left out."""
    boxes = np.array([[10, 10, 30, 30], [100, 100, 120, 120]])
    nothing = np.empty((0, 4, 4, 3), np.uint8)
    data = training_set.TrainingSet(
        nothing, nothing[..., 0], np.array([1, 1]), boxes, np.array([4, 6]), np.array([0.9, 0.3]), np.array([400, 400])
    )
    given = np.array([[12, 10, 32, 30], [98, 100, 120, 121], [23, 10, 43, 30], [19, 10, 40, 30], [200, 200, 220, 220]])
    found = crops.candidates(data, 1, given, np.full(len(given), 0.5))
    np.testing.assert_array_equal(found.boxes, [given[0], given[2], given[4], boxes[0]])
    np.testing.assert_array_equal(found.wanted, [boxes[0], given[2], given[4], boxes[0]])
    np.testing.assert_array_equal(found.class_id, [4, -1, -1, 4])
    assert set(found.scene) == {1}
    nothing = crops.candidates(data, 0, given, np.full(len(given), 0.5))
    assert set(nothing.class_id) == {-1} and len(nothing.boxes) == 5


# A training in small


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Eight scenes."""
    return training_set.render(tmp_path_factory.mktemp("pictures"), 8, 0, workers=1)


@pytest.fixture(scope="module")
def learner():
    """Of the proposer: compiled once."""
    loss = partial(proposed, middles=cells(WINDOW, WINDOW))
    return Learner(Proposer(training=True), loss, (np.zeros((1, WINDOW, WINDOW, 3), np.uint8),), 150, 0)


def test_the_proposer_learns_two_windows_by_heart(small, learner):
    (windows,), (labels,) = training_set.batch(small, (0,), 2)
    for _ in range(150):
        parts = learner.step((windows,), (labels,))
    assert sum(float(value) for value in parts.values()) < 0.7
    boxes, logits = jax.jit(Proposer(False).apply)({"params": learner.weights()}, windows)
    fits = [
        np.max(overlap(boxes[i], box)[logits[i] > -1], initial=0)
        for i in range(2)
        for box in labels.boxes[i][labels.found[i]]
    ]
    assert len(fits) > 3 and np.median(fits) > 0.7


def test_the_refiner_learns_some_crops_by_heart(small):
    some = [crops.candidates(small, scene, BACKGROUND, np.full(len(BACKGROUND), 0.5)) for scene in range(8)]
    names = ("scene", "boxes", "wanted", "class_id", "likely")
    found = crops.Candidates(*(np.concatenate([getattr(one, name) for one in some]) for name in names))
    given, (wanted, class_id) = crops.batch(small, found, (0,), 8)
    learner = Learner(Refiner(len(CLASS_NAMES), training=True), refined, given, 400, 0)
    for _ in range(400):
        parts = learner.step(given, (wanted, class_id))
    assert sum(float(value) for value in parts.values()) < 0.5
    boxes, logits = jax.jit(Refiner(len(CLASS_NAMES), False).apply)({"params": learner.weights()}, *given)
    thing = class_id >= 0
    assert thing.sum() == 4 and (np.asarray(logits).argmax(1) == class_id)[thing].all()
    assert (np.asarray(logits)[~thing] < 0).all() and np.median(overlap(boxes, wanted)[thing]) > 0.8


def test_the_same_seed_trains_the_same_bits(small, learner):
    ends = []
    for seed in (3, 3, 4):
        learner.restart(seed)
        for step in range(3):
            learner.step(*training_set.batch(small, (0, step), 2))
        ends.append(np.concatenate([leaf.ravel() for leaf in jax.tree.leaves(jax.device_get(learner.weights()))]))
    np.testing.assert_array_equal(ends[0], ends[1])
    assert not np.array_equal(ends[0], ends[2])


# The command line


@pytest.mark.parametrize(
    "arguments, says",
    [
        (["train", "--out", "."], "exists"),
        (["train", "--scenes", "0", "--out", "nowhere"], "scenes is 1 or more"),
        (["train", "--seed", "-1", "--out", "nowhere"], "seed is 0 or more"),
        (["train", "--epochs", "3"], "--epochs"),
        (["eval", "--scenes", "0"], "scenes is 1 or more"),
        (["eval", "--seed", "-1"], "seed is 0 or more"),
        (["eval", "--weights", "nowhere.npz"], "nowhere.npz"),
    ],
)
def test_bad_command_lines(arguments, says, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["vision", *arguments]) == 2
    printed = capsys.readouterr()
    assert says in printed.err and printed.err.count("\n") == 1 and not printed.out
    assert not list(tmp_path.iterdir())
