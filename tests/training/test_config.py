"""Configuration: TOML in, TOML out, overrides, and what is said of mistakes."""

import dataclasses
import re

import jax
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arm5dof.ddpg import DDPGConfig
from arm5dof.envs.reach import ReachConfig
from arm5dof.envs.reach_pose import ReachPoseConfig
from arm5dof.errors import UserError
from arm5dof.runtime import files
from arm5dof.training import config


@pytest.mark.parametrize("name", config.shipped_experiments())
def test_shipped_experiments_survive_a_round_trip(name, tmp_path):
    loaded = config.load_config(name)
    (tmp_path / "again.toml").write_text(config.dumps(loaded))
    assert config.load_config(tmp_path / "again.toml") == loaded


def test_default_experiment_is_the_papers_budget_in_servo_dynamics():
    reach = config.load_config()
    assert (reach.env.dynamics, reach.train.episodes, reach.env.episode_length) == ("servo", 400, 160)


def test_names_are_unique_so_that_a_flag_needs_no_section():
    names = [f.name for f in config.fields(config.load_config())]
    assert len(names) == len(set(names))


def test_every_field_is_documented_and_overridable():
    for f in config.fields(config.load_config()):
        assert f.help, f.name
        text = str(f.value).lower() if isinstance(f.value, bool) else str(f.value)
        for flag in (f.name, f.name.replace("_", "-"), f"{f.section}.{f.name}"):
            assert config.load_config("reach.toml", **{flag: text}) is not None


@given(
    lr=st.floats(1e-9, 1.0),
    discount=st.floats(0, 1),
    batch=st.integers(1, 10**6),
    norm=st.booleans(),
    activation=st.sampled_from(["relu", "gelu", "tanh"]),
)
def test_any_valid_value_survives_text(lr, discount, batch, norm, activation):
    overrides = {
        "actor-lr": repr(lr),
        "discount": repr(discount),
        "batch_size": str(batch),
        "ddpg.layer_norm": str(norm).lower(),
        "activation": activation,
    }
    found = config.load_config("reach.toml", **overrides).ddpg
    assert (found.actor_lr, found.discount, found.batch_size) == (lr, discount, batch)
    assert (found.layer_norm, found.activation) == (norm, activation)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"ddpg": {"batch_sise": 3}}, "did you mean 'batch_size'"),
        ({"dppg": {}}, "did you mean 'ddpg'"),
        ({"ddpg": {"batch_size": "many"}}, "ddpg.batch_size = 'many'"),
        ({"ddpg": {"batch_size": 2.5}}, "integer"),
        ({"ddpg": {"batch_size": 0}}, "greater than or equal to 1"),
        ({"ddpg": {"actor_depth": 3000}}, "less than or equal to 100"),
        ({"ddpg": {"noise": 10**400}}, "ddpg.noise"),
        ({"ddpg": {"noise": [-(2**63)]}}, "ddpg.noise = (-9223372036854775808,): input should be a valid number"),
        ({"ddpg": {"noise": {"low": 1}}}, "ddpg.noise = {'low': 1}: input should be a valid number"),
        ({"ddpg": {"discount": 1.5}}, "less than or equal to 1"),
        ({"ddpg": {"actor_lr": float("nan")}}, "finite"),
        ({"ddpg": {"layer_norm": 1}}, "boolean"),
        ({"env": {"dynamics": "magic"}}, "'servo' or 'kinematic'"),
        ({"env": 3}, "env"),
    ],
)
def test_mistakes_are_named_in_one_line(values, said):
    with pytest.raises(UserError) as caught:
        config.build(values, "file.toml")
    message = str(caught.value)
    assert said in message and message.startswith("file.toml: ") and "\n" not in message


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ({"batch-sise": "3"}, "'batch_size'"),
        ({"zzz": "3"}, "unknown setting 'zzz': `Config.flat()` lists the valid ones"),
        ({"batch-size": "many"}, "integer"),
        ({"discount": "2"}, "less than"),
        ({"seed": "-1"}, "greater than"),
        ({"seed": "4294967296"}, "less than"),
        ({"seed": "9223372036854775808"}, "less than"),
        ({"seed": "1]"}, "integer"),
    ],
)
def test_mistakes_on_the_command_line(overrides, said):
    with pytest.raises(UserError, match=re.escape(said)):
        config.load_config("reach.toml", **overrides)


def test_numbers_are_traced_and_sizes_are_not():
    leaves, _ = jax.tree.flatten(DDPGConfig())
    traced = [f.name for f in dataclasses.fields(DDPGConfig) if not f.metadata.get("static")]
    assert len(leaves) == len(traced)
    assert {"actor_lr", "critic_lr", "discount", "tau", "noise"} <= set(traced)
    assert not {"batch_size", "actor_width", "heads"} & set(traced)
    changed = jax.tree.map(lambda x: 2 * x, DDPGConfig())
    assert changed.actor_lr == 2 * DDPGConfig().actor_lr and changed.batch_size == DDPGConfig().batch_size


def test_missing_and_broken_files(tmp_path):
    with pytest.raises(UserError, match=r"kinematic\.toml, paper\.toml, reach\.toml"):
        config.load_config("nothing.toml")
    (tmp_path / "broken.toml").write_text("[env\n")
    with pytest.raises(UserError, match="not valid TOML"):
        config.load_config(tmp_path / "broken.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UserError, match="not valid TOML"):
        config.load_config(tmp_path / "binary.toml")
    (tmp_path / "folder.toml").mkdir()
    with pytest.raises(UserError, match=r"folder\.toml cannot be read: Is a directory"):
        files.read_toml(tmp_path / "folder.toml")


def test_what_a_file_leaves_open_is_as_in_its_tasks_file(tmp_path):
    (tmp_path / "mine.toml").write_text('[env]\ndynamics = "kinematic"\n[ddpg]\nheads = 3\n')
    mine, reach = config.load_config(tmp_path / "mine.toml"), config.load_config("reach.toml")
    assert mine.ddpg == dataclasses.replace(reach.ddpg, heads=3) != DDPGConfig(heads=3)


def test_text_and_numbers_are_alike():
    texts = config.load_config(actor_lr=".001", layer_norm="TRUE", heads="4", arm="arm7.xml")
    assert texts == config.load_config(actor_lr=0.001, layer_norm=True, heads=4, arm="arm7.xml")


@pytest.mark.parametrize(
    ("cls", "values", "said"),
    [
        (DDPGConfig, {"actor_lr": -1}, "actor_lr = -1: input should be greater than 0"),
        (DDPGConfig, {"heads": 2.5}, "valid integer"),
        (ReachConfig, {"dynamics": "nope"}, "dynamics = 'nope': input should be 'servo' or 'kinematic'"),
        (ReachPoseConfig, {"substeps": 0}, "substeps"),
    ],
)
def test_constructors_validate(cls, values, said):
    with pytest.raises(UserError, match=re.escape(said)):
        cls(**values)
    with pytest.raises(UserError, match=re.escape(said)):
        dataclasses.replace(cls(), **values)


def test_traced_numbers_pass_for_numbers():
    rate = jax.jit(lambda lr: DDPGConfig(actor_lr=lr).actor_lr * 2)(0.25)
    assert rate == 0.5
    assert jax.vmap(lambda lr: dataclasses.replace(DDPGConfig(), actor_lr=lr).actor_lr)(jax.numpy.ones(3)).shape == (3,)


@pytest.mark.parametrize(
    ("task", "said"),
    [
        ("nothing", "no task 'nothing': it is one of those shipped (reach, reach_pose)"),
        ("../reach", "no task"),
        ("nowhere:Class", "cannot import task 'nowhere:Class' (ModuleNotFoundError"),
        ("json:JSONDecoder", "'json:JSONDecoder' is no task: it takes a class that inherits from arm5dof.Task"),
        ("json:Nothing", "is no task"),
        (3, "no task 3"),
    ],
)
def test_tasks_that_are_none(task, said):
    with pytest.raises(UserError, match=re.escape(said)):
        config.build({"env": {"task": task}}, "file.toml")


def test_a_name_in_two_sections_needs_its_section():
    known = [*config.fields(config.load_config()), config.Field("env", "seed", 0, "", None)]
    with pytest.raises(UserError, match=r"train\.seed or env\.seed"):
        config.find("seed", known)
    assert config.find("env.seed", known).section == "env"


def test_a_bare_name_that_could_be_either_of_two_files_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "kinematic.toml").write_text("[train]\nseed = 7\n")
    with pytest.raises(UserError, match=r"say \./kinematic\.toml"):
        config.load_config("kinematic.toml")
    assert config.load_config("./kinematic.toml").train.seed == 7
