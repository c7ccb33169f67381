"""The command line: what it does, and what it says of bad input: one line on stderr, exit status 2, nothing lost."""

import asyncio
import csv
import gc
import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest
from helpers.serial import serial_arm

from arm5dof.arm import load_arm
from arm5dof.cli import main as cli
from arm5dof.cli import solve
from arm5dof.errors import UserError
from arm5dof.training import checkpoint
from arm5dof.training.checkpoint import Checkpoints
from arm5dof.training.config import fixed, load_config
from arm5dof.training.run import Run, free_folder

TINY = (
    "kinematic.toml --episodes 4 --num-envs 2 --evaluate-every 2 --checkpoint-every 2 --episode-length 32 "
    "--batch-size 32 --actor-width 16 --heads 2 --updates-per-step 16 --targets 100 --interim-targets 100 "
    "--replay-capacity 1024"
)


def run(*arguments):
    return cli.main([str(a) for a in arguments])


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A finished run, too short to be any good."""
    folder = tmp_path_factory.mktemp("runs") / "tiny"
    assert run("train", *TINY.split(), "--out", folder) == 0
    return folder


@pytest.fixture
def fails(capsys):
    """Run a command that must fail; return its one line."""

    def check(*arguments):
        capsys.readouterr()
        assert run(*arguments) == 2
        err = capsys.readouterr().err
        lines = [line for line in err.splitlines() if line.startswith("arm5dof: ")]
        assert len(lines) == 1 and "Traceback" not in err and err.endswith(lines[0] + "\n")
        return lines[0]

    return check


def digest(folder):
    """Everything in a folder, to see that nothing was touched; the lock holds nothing."""
    files = sorted(p for p in Path(folder).rglob("*") if p.is_file() and p.name != ".lock")
    return [(str(p), hashlib.sha256(p.read_bytes()).hexdigest()) for p in files]


def test_a_run_leaves_everything(trained):
    names = {p.name for p in trained.iterdir()}
    kept = {"config.toml", "run.json", "model.mjb.gz", "model.zip"}
    made = {"metrics.csv", "evaluations.json", "checkpoints", "report.md", "learning.png"}
    assert kept | made <= names
    assert (trained / "learning.png").read_bytes().startswith(b"\x89PNG")
    rows = list(csv.DictReader(open(trained / "metrics.csv")))
    assert [int(row["steps"]) for row in rows] == [16, 32, 48, 64]
    assert int(rows[-1]["episodes"]) == 4 and int(rows[-1]["env_steps"]) == 128
    report = (trained / "report.md").read_text()
    assert "| one_shot |" in report and "| ddpg.batch_size | 32 |" in report
    assert [e["episodes"] for e in json.loads((trained / "evaluations.json").read_text())] == [2, 4]


def test_eval_json_has_exactly_these_keys_and_repeats_itself(trained, capsys):
    def evaluate(seed):
        capsys.readouterr()
        assert run("eval", trained, "--targets", 100, "--seed", seed, "--json") == 0
        return json.loads(capsys.readouterr().out)

    found = evaluate(1)
    assert list(found) == ["one_shot", "refined", "episode", "at_limit"]
    assert 0 <= found["at_limit"]["percent"] <= 100
    for accuracy in list(found.values())[:3]:
        assert list(accuracy) == ["median_mm", "p95_mm", "within"]
        assert list(accuracy["within"]) == ["1", "5", "10", "20"]
        shares = list(accuracy["within"].values())
        assert shares == sorted(shares) and shares[0] >= 0 and shares[-1] <= 100
        assert 0 <= accuracy["median_mm"] <= accuracy["p95_mm"]
    assert evaluate(1) == found != evaluate(2)


def reached_by(row, names):
    """Where C MuJoCo says that an answer's joint angles lead."""
    model = mujoco.MjModel.from_xml_path(str(Path(__file__).parents[2] / "mjcf" / "reach.xml"))
    data = mujoco.MjData(model)
    for name in names:
        data.joint(name).qpos = float(row[name])
    mujoco.mj_kinematics(model, data)
    return data.site("ee").xpos


def test_solve_answers_and_tells_its_error(trained, capsys):
    targets = [[0.15, 0.05, 0.12], [-0.1, 0.1, 0.2]]
    words = [word for t in targets for word in ("--target", *t)]
    capsys.readouterr()
    assert run("solve", trained, *words, "--json", "--tolerance-mm", 1000) == 0
    answers = json.loads(capsys.readouterr().out)
    assert [a["target_m"] for a in answers] == targets
    loaded = load_arm("reach.xml")
    for answer in answers:
        joints = answer["joints_rad"]
        assert list(joints) == [f"theta_{i}" for i in range(1, 6)]
        q = np.array(list(joints.values()))
        assert (q >= loaded.lower - 1e-6).all() and (q <= loaded.upper + 1e-6).all()
        miss = np.linalg.norm(reached_by(joints, joints) - answer["target_m"]) * 1e3
        assert miss == pytest.approx(answer["error_mm"], abs=1e-3)


def test_solve_gives_every_answer_and_the_nearest(trained, capsys):
    target = ("solve", trained, "--target", 0.15, 0.05, 0.12, "--tolerance-mm", 1000, "--json")
    capsys.readouterr()
    assert run(*target, "--all") == 0
    every = [list(row["joints_rad"].values()) for row in json.loads(capsys.readouterr().out)]
    assert len(every) > 1
    assert run(*target) == 0
    (best,) = json.loads(capsys.readouterr().out)
    # None of the actor's is within a millimetre, so that the best counts wherever the joints are.
    assert run(*target, "--near", *every[0]) == 0
    (near,) = json.loads(capsys.readouterr().out)
    assert near["error_mm"] <= best["error_mm"] + 1e-3


def test_solve_follows_a_path_or_says_where_a_joint_jumps(trained, tmp_path, fails):
    line = np.array([0.15, 0.05, 0.12]) + np.linspace(0, 1, 20)[:, None] * [0.02, -0.02, 0.02]
    (tmp_path / "line.csv").write_text("x,y,z\n" + "\n".join(",".join(map(str, point)) for point in line))
    out = tmp_path / "answers.csv"
    assert run("solve", trained, "--csv", tmp_path / "line.csv", "--out", out, "--path", "--tolerance-mm", 1) == 0
    rows = list(csv.DictReader(open(out)))
    q = np.array([[float(row[f"theta_{i}"]) for i in range(1, 6)] for row in rows])
    assert q.shape == (20, 5) and np.abs(np.diff(q, axis=0)).max() < 0.5
    apart = ("--target", 0.2, 0.1, 0.1, "--target", -0.2, -0.1, 0.2, "--tolerance-mm", 1000)
    assert "1 jumps of a joint on the path, the first to (-0.2, -0.1, 0.2) m" in fails(
        "solve", trained, *apart, "--path"
    )
    assert "leave out --all" in fails("solve", trained, *apart, "--path", "--all")
    assert "leave out --near" in fails("solve", trained, *apart, "--all", "--near", *[0] * 5)


def test_solve_takes_and_gives_csv(trained, tmp_path):
    points, answers = tmp_path / "points.csv", tmp_path / "answers.csv"
    points.write_text("name,x,y,z\na,0.15,0.05,0.12\nb,0.1,-0.1,0.2\n")
    assert run("solve", trained, "--csv", points, "--out", answers, "--tolerance-mm", 1000) == 0
    rows = list(csv.DictReader(open(answers)))
    assert len(rows) == 2 and all(row["reached"] == "1" for row in rows)
    for row in rows:
        target = [float(row[axis]) for axis in "xyz"]
        miss = np.linalg.norm(reached_by(row, [f"theta_{i}" for i in range(1, 6)]) - target) * 1e3
        assert miss == pytest.approx(float(row["error_mm"]), abs=1e-3)


def test_slides_are_metres_for_programs_and_millimetres_for_people(tmp_path, capsys):
    spec = serial_arm(4, seed=2, slides=True)
    (tmp_path / "slides.xml").write_text(spec.to_xml())
    small = {"actor_width": 16, "actor_depth": 1, "critic_width": 8, "critic_depth": 1, "replay_capacity": 64}
    created = Run.create(load_config("kinematic.toml", arm=str(tmp_path / "slides.xml"), **small), tmp_path / "run")
    trainer = created.trainer()
    trainer.state = trainer._init(created.config.ddpg, jax.random.key(0))
    created.checkpoints().save(trainer.state)
    arm = created.env.arm
    hinges = [name for name, slides in zip(arm.joint_names, arm.slides, strict=True) if not slides]
    slides = [name for name in arm.joint_names if name not in hinges]
    assert hinges and slides and arm.joint_names != (*hinges, *slides)

    asked = ("--target", 0.1, 0.2, 0.3, "--tolerance-mm", 1e6, "--refine", 0)
    (tmp_path / "in.csv").write_text("x,y,z\n0.1,0.2,0.3\n")
    capsys.readouterr()
    assert run("solve", tmp_path / "run", *asked, "--json") == 0
    (answer,) = json.loads(capsys.readouterr().out)
    assert (list(answer["joints_rad"]), list(answer["joints_m"])) == (hinges, slides)
    joints = answer["joints_rad"] | answer["joints_m"]
    data = mujoco.MjData(arm.mj_model)
    for name, value in joints.items():
        data.joint(name).qpos = value
    mujoco.mj_kinematics(data.model, data)
    assert 1e3 * np.linalg.norm(data.site("ee").xpos - [0.1, 0.2, 0.3]) == pytest.approx(answer["error_mm"], abs=1e-2)

    assert run("solve", tmp_path / "run", "--csv", tmp_path / "in.csv", *asked[4:]) == 0
    (row,) = csv.DictReader(capsys.readouterr().out.splitlines())
    assert list(row) == ["x", "y", "z", *arm.joint_names, "error_mm", "reached"]
    assert {name: float(row[name]) for name in joints} == pytest.approx(joints, abs=1e-7)

    assert run("solve", tmp_path / "run", *asked) == 0
    angles = "  ".join(f"{name} {np.degrees(joints[name]):.2f}" for name in hinges)
    shifts = "  ".join(f"{name} {1e3 * joints[name]:.2f}" for name in slides)
    assert f":  {angles} degrees  {shifts} mm  error " in capsys.readouterr().out


def test_solve_refuses_bad_targets(trained, tmp_path, fails):
    before = digest(trained)
    assert "not finite" in fails("solve", trained, "--target", "nan", 0, 0)
    assert "not finite" in fails("solve", trained, "--target", 0, "inf", 0)
    said = fails("solve", trained, "--target", 1, 0, 0)
    assert "1 of 1 targets not reached" in said and "reaches 0.267 m" in said
    assert "either" in fails("solve", trained)
    assert "expected 3 arguments" in fails("solve", trained, "--target", 1, 2)
    for name, text, expected in [
        ("empty.csv", "", "header"),
        ("header.csv", "x,y,z\n", "no targets"),
        ("columns.csv", "a,b\n1,2\n", "header"),
        ("words.csv", "x,y,z\n0,0,there\n", "line 2"),
        ("short.csv", "x,y,z\n0,0\n", "line 2"),
        ("nan.csv", "x,y,z\n0.1,0.1,nan\n", "not finite"),
        ("large.csv", "x,y,z\n0.1,0.1,1e308\n", "too large"),
        ("long.csv", "x,y,z\n0,1,0.1,0.1\n", "line 2: more values than columns"),
    ]:
        (tmp_path / name).write_text(text)
        assert expected in fails("solve", trained, "--csv", tmp_path / name)
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00\x01")
    assert "not a CSV" in fails("solve", trained, "--csv", tmp_path / "binary.csv")
    assert "No such file" in fails("solve", trained, "--csv", tmp_path / "absent.csv")
    (tmp_path / "good.csv").write_text("x,y,z\n0.15,0.05,0.12\n")
    (tmp_path / "there.csv").write_text("precious")
    assert "exists" in fails("solve", trained, "--csv", tmp_path / "good.csv", "--out", tmp_path / "there.csv")
    assert (tmp_path / "there.csv").read_text() == "precious"
    assert digest(trained) == before


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--batch-sise", "3"], "did you mean --batch-size?"),
        (["--zzz"], "unknown option --zzz: see arm5dof train --help"),
        (["--batch-size", "many"], "valid integer"),
        (["--batch-size"], "needs a value"),
        (["--discount", "1.5"], "less than or equal to 1"),
        (["nowhere.toml"], "no experiment 'nowhere.toml'"),
        (["reach.toml", "again.toml"], "unexpected argument 'again.toml'"),
        (["--arm", "nowhere.xml"], "no MJCF file 'nowhere.xml'"),
        (["--site", "nose"], "no site, body or geom 'nose'"),
        (["--episodes", "30"], "no multiple of num_envs"),
        (["--epoch-steps", "7"], "does not divide"),
        (["--replay-capacity", "2000000000"], "replay_capacity = 2000000000 takes 296.0 GB and"),
        (["--replay-capacity", "100000000000"], "less than 2147483648"),
        (["--updates-per-step", "1000000", "--batch-size", "60000"], "batch_size = 60000 takes"),
        (
            [f"--{name}=2000000000" for name in ("num-envs", "episodes", "evaluate-every", "checkpoint-every")],
            "num_envs = 2000000000 takes",
        ),
        (["--episodes", "1000000000"], "are more than 2147483647 updates"),
        (["--actor-depth", "1000000"], "less than or equal to 100"),
        (["--resume", "nowhere"], "no run"),
        (["--resume", "nowhere", "--seed", "3"], "no run"),
        (["--resume", "nowhere", "--smoke", "--out", "there"], "leave out --out, --smoke"),
        (["kinematic.toml", "--log", "tensorbord"], "no logger 'tensorbord': did you mean 'tensorboard'?"),
    ],
)
def test_train_refuses_bad_input(arguments, said, fails, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert said in fails("train", *arguments)
    assert list(tmp_path.iterdir()) == []


def test_train_refuses_broken_models(fails, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, text, said in [
        ("broken.xml", "<mujoco><worldbody>", "cannot read"),
        ("unknown.xml", "<mujoco><nonsense/></mujoco>", "cannot read"),
        ("empty.xml", "<mujoco/>", "no joints"),
        (
            "unactuated.xml",
            "<mujoco><worldbody><body>"
            '<joint name="a" range="-1 1"/><geom size="1"/><site name="ee" pos="1 0 0"/></body></worldbody></mujoco>',
            "no position actuator",
        ),
        (
            "implicit.xml",
            '<mujoco><option integrator="implicit" timestep="0.1"/><worldbody><body><joint name="a" range="-1 1"/>'
            '<geom size="1"/><site name="ee" pos="1 0 0"/></body></worldbody>'
            '<actuator><position joint="a" kp="1e8" kv="1e6"/></actuator></mujoco>',
            "the physics of the servos blows up at its time step of 0.1 s",
        ),
    ]:
        (tmp_path / name).write_text(text)
        assert said in fails("train", "--arm", name, "--servo", "model")
    assert not (tmp_path / "runs").exists()


def test_what_learns_nothing_is_refused_and_what_diverges_says_so(fails, tmp_path, capsys):
    few = fails("train", *TINY.split(), "--batch-size", 4096, "--out", tmp_path / "few")
    assert "batch_size = 4096" in few and "never holds more than 128 transitions" in few
    assert not (tmp_path / "few").exists()
    assert run("train", *TINY.split(), "--critic-lr", 1e30, "--out", tmp_path / "lost") == 1
    err = capsys.readouterr().err
    assert "arm5dof: the training diverged: " in err and "try a smaller actor_lr" in err and "Traceback" not in err


def test_runs_never_overwrite_each_other(trained, fails, tmp_path, monkeypatch):
    before = digest(trained)
    assert "exists" in fails("train", *TINY.split(), "--out", trained)
    assert digest(trained) == before
    monkeypatch.chdir(tmp_path)
    for expected in ("runs/reach", "runs/reach-2", "runs/reach-3"):
        folder = free_folder("reach")
        assert str(folder) == expected
        folder.mkdir(parents=True)


def test_a_finished_run_resumes_to_the_same_end(trained):
    before = digest(trained / "checkpoints")
    assert run("train", "--resume", trained) == 0
    assert digest(trained / "checkpoints") == before


def test_a_longer_budget_and_curves_in_tensorboard(trained, tmp_path, fails):
    folder = copy(trained, tmp_path / "longer")
    for option, said in [
        (["--seed", 3], "leave out train.seed; what may change is env.correction"),
        (["--episodes", 2], "has trained 4 episodes, more than 2: give 4 or more"),
        (["--episodes", 7], "no multiple of num_envs"),
        (["--episode", 8], "unknown option --episode: did you mean --episodes?"),
        (["--episodes"], "--episodes needs a value"),
    ]:
        assert said in fails("train", "--resume", folder, *option)
    assert digest(folder) == [(path.replace(str(trained), str(folder)), sha) for path, sha in digest(trained)]
    assert run("train", "--resume", folder, "--episodes", 6, "--log", "tensorboard") == 0
    assert Run.open(folder).metrics["env_steps"][-1] == 192 and Run.open(folder).config.train.episodes == 6
    assert len(list((folder / "tensorboard").iterdir())) == 1


def test_missing_extras_are_said_before_anything_starts(fails, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    monkeypatch.delitem(sys.modules, "tensorboard.summary.writer.record_writer", raising=False)
    assert "pip install 'arm5dof[tensorboard]'" in fails("train", "--log", "tensorboard")
    assert list(tmp_path.iterdir()) == []


def copy(folder, target):
    subprocess.run(["cp", "-r", str(folder), str(target)], check=True)
    return target


def newest(folder):
    return max((folder / "checkpoints").iterdir(), key=lambda p: int(p.name))


@pytest.fixture(scope="module")
def like(trained):
    return Run.open(trained).trainer().like


def restore(folder, like):
    made_with = fixed(Run.open(folder).config)
    return jax.tree.leaves(Checkpoints(folder / "checkpoints", made_with, read_only=True).restore(like))


@pytest.mark.parametrize("kind", ["truncated", "flipped", "removed"])
def test_damaged_checkpoints_are_recognised(kind, trained, like, tmp_path):
    """Whichever file is hit: a checkpoint is refused, or the damage was in bytes that do not matter."""
    expected, refused = restore(trained, like), 0
    for i, file in enumerate(sorted(p for p in newest(trained).rglob("*") if p.is_file())):
        folder = copy(trained, tmp_path / str(i))
        damaged = folder / file.relative_to(trained)
        content = bytearray(file.read_bytes())
        if kind == "removed":
            damaged.unlink()
        elif kind == "truncated":
            damaged.write_bytes(content[: len(content) // 2])
        else:
            content[len(content) // 2 : len(content) // 2 + 1] = bytes(
                [content[len(content) // 2] ^ 0xFF] if content else []
            )
            damaged.write_bytes(content)
        try:
            found = restore(folder, like)
        except UserError as error:
            refused += 1
            assert "checkpoint" in str(error) and "\n" not in str(error)
        else:
            for a, b in zip(found, expected, strict=True):
                assert (a == b).all(), file
    assert refused >= 4


def test_a_damaged_checkpoint_is_one_line_and_left_as_it_is(trained, tmp_path, fails):
    folder = copy(trained, tmp_path / "damaged")
    for file in newest(folder).rglob("manifest.ocdbt"):
        file.write_bytes(file.read_bytes()[:50])
    before = digest(folder)
    assert "damaged" in fails("train", "--resume", folder)
    assert "damaged" in fails("eval", folder)
    assert digest(folder) == before


def test_foreign_checkpoints_are_recognised(trained, tmp_path, fails, monkeypatch):
    folder = copy(trained, tmp_path / "other")
    text = (folder / "config.toml").read_text()
    (folder / "config.toml").write_text(text.replace("actor_width = 16", "actor_width = 24"))
    assert "ddpg.actor_width = 16, now 24): set them back in config.toml" in fails("eval", folder)
    assert "ddpg.actor_width = 16, now 24): set them back in config.toml" in fails("train", "--resume", folder)

    folder = copy(trained, tmp_path / "foreign")
    for item in newest(folder).iterdir():
        subprocess.run(["rm", "-r", str(item)], check=True)
    (newest(folder) / "model.pkl").write_bytes(b"cos\nsystem\n(S'touch owned'\ntR.")
    monkeypatch.chdir(tmp_path)
    assert "checkpoint" in fails("eval", folder)
    assert "checkpoint" in fails("train", "--resume", folder)
    assert not list(tmp_path.rglob("owned")), "the planted pickle was executed"

    folder = tmp_path / "empty"
    folder.mkdir()
    assert "is no run" in fails("eval", folder)
    for name in ("config.toml", "run.json", "model.mjb.gz"):
        (folder / name).write_bytes((trained / name).read_bytes())
    assert "no checkpoint yet" in fails("eval", folder)


def test_a_full_disk_loses_nothing(tmp_path):
    """Past its file-size limit a process gets the errors of a full disk; the limit is set once a checkpoint exists."""
    folder = tmp_path / "full"
    code = """
import resource, sys
from arm5dof.cli.main import main
from arm5dof.training.checkpoint import Checkpoints

save = Checkpoints.save
def limited(self, training):
    if self.latest is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
    save(self, training)
Checkpoints.save = limited
sys.exit(main(sys.argv[1:]))
"""
    done = subprocess.run(
        [sys.executable, "-c", code, "train", *TINY.split(), "--out", str(folder)],
        capture_output=True,
        text=True,
        cwd=tmp_path,
    )
    assert done.returncode == 2, done.stderr
    lines = [line for line in done.stderr.splitlines() if line.startswith("arm5dof: ")]
    assert len(lines) == 1 and "--resume" in lines[0] and "Traceback" not in done.stderr
    assert run("train", "--resume", folder) == 0
    assert json.loads((folder / "evaluations.json").read_text())[-1]["episodes"] == 4


@pytest.mark.parametrize("saved", [0, 1])
def test_how_to_go_on_is_said_where_there_is_something_to_go_on_from(saved, fails, tmp_path, monkeypatch):
    save, calls = Checkpoints.save, []

    def limited(self, training):
        calls.append(self)
        if len(calls) > saved:
            raise UserError("no more")
        save(self, training)

    monkeypatch.setattr(Checkpoints, "save", limited)
    said = fails("train", *TINY.split(), "--out", tmp_path / "run")
    assert said == "arm5dof: no more" + f"; go on with arm5dof train --resume {tmp_path / 'run'}" * saved
    assert Run.open(tmp_path / "run").has_checkpoint == bool(saved)
    assert saved or "no checkpoint yet" in fails("eval", tmp_path / "run")


def test_failures_that_nobody_waits_for_are_silent(caplog, capfd):
    """After a first write has failed, tensorstore's others may or may not fail in time for someone to ask."""

    async def write():
        raise OSError("File too large")

    async def give_up():
        task = asyncio.ensure_future(write())
        await asyncio.sleep(0.01)
        del task
        gc.collect()

    with pytest.raises(UserError, match="cannot write"), checkpoint._as_user_error("cannot write"):
        asyncio.run(give_up())
        raise OSError("File too large")
    assert not caplog.records and not capfd.readouterr().err
    told = pytest.raises(UserError, match=r"cannot write \(No space left on device\)")
    with told, checkpoint._as_user_error("cannot write"):
        raise ValueError(f"Failed to write 7738 bytes [os_error_code='28']; {'metadata ' * 99}")


def test_a_run_may_be_called_like_a_number(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("1e5", "nan", "12"):
        Path(name).mkdir()
        assert solve._run_folder([name, "--target", "0.1", "0", "12"]) == (Path(name), ["--target", "0.1", "0", "12"])
    assert solve._run_folder(["--target", "0.1", "0", "12", "runs/a"])[0] == Path("runs/a")


def test_a_name_that_is_no_text_is_one_line(fails):
    assert "'not-\\udcff' is no UTF-8: rename what it names" in fails("arm", os.fsdecode(b"not-\xff"))


def test_help_lists_every_setting(capsys):
    with pytest.raises(SystemExit) as caught:
        run("train", "--help")
    assert caught.value.code == 0
    text = capsys.readouterr().out
    assert "--resume" in text and "--actor-lr" in text and "--substeps" in text
    with pytest.raises(SystemExit):
        run("train", "kinematic.toml", "--help")
    assert "(default kinematic)" in " ".join(capsys.readouterr().out.split()), "as the experiment has it"
    assert run() == 0 and "COMMAND" in capsys.readouterr().out


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_interrupt_is_no_traceback(tmp_path, number, status):
    """Ctrl-C, or a cluster's request, ends a run with a word on how to go on, and a checkpoint of what was trained."""
    command = [
        sys.executable,
        "-m",
        "arm5dof",
        "train",
        *TINY.split(),
        "--episodes",
        "4000",
        "--checkpoint-every",
        "4000",
        "--out",
        str(tmp_path / "run"),
    ]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=os.environ)
    metrics = tmp_path / "run" / "metrics.csv"
    while not (metrics.exists() and metrics.stat().st_size):  # The first epoch is over, so nothing compiles any more.
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(number)
    _, err = process.communicate(timeout=120)
    assert process.returncode == status and "Traceback" not in err
    saved = f"go on with arm5dof train --resume {tmp_path / 'run'}" in err
    assert saved or (number == signal.SIGINT and "before the first checkpoint" in err), err
    if saved:
        assert Run.open(tmp_path / "run").policy().solve([0.1, 0.1, 0.1]).q.shape == (5,)


def test_nobody_who_reads_is_no_traceback(trained):
    command = f"{sys.executable} -m arm5dof solve {trained} --target 0.1 0.1 0.1 --tolerance-mm 1000"
    for after, status in ("| true; exit ${PIPESTATUS[0]}", 141), (">&-", 0):
        done = subprocess.run(["bash", "-c", f"{command} {after}"], capture_output=True, text=True)
        assert done.returncode == status and not done.stderr, done.stderr
