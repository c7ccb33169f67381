"""What a sweep may ask for, and what is said of what it may not."""

from __future__ import annotations

import itertools
import tomllib

import pytest
from helpers.errors import said
from hypothesis import given
from hypothesis import strategies as st

from arm5dof.errors import UserError
from arm5dof.runtime import files
from arm5dof.sweeps import groups, spec
from arm5dof.training import config
from arm5dof.training.config import load_config

BASE = load_config("kinematic.toml")

lists = st.lists(st.floats(1e-5, 1.0), min_size=1, max_size=3, unique=True)
counts = st.integers(1, 2)
intervals = st.tuples(st.floats(1e-5, 1e-2), st.floats(2e-2, 1.0)).map(list)
axis = st.one_of(
    lists,
    st.builds(lambda interval, count: {"log_uniform": interval, "count": count}, intervals, counts),
    st.builds(lambda interval, count: {"uniform": interval, "count": count}, intervals, counts),
    st.builds(lambda start, steps: {"range": [start, start + 0.05 * steps, 0.05]}, st.floats(0.1, 0.3), counts),
)
keys = st.sampled_from(["range", "uniform", "log_uniform", "count", "x"])
anything = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(keys, inner, max_size=3),
    max_leaves=6,
)


def parse(axes, **others):
    return spec.parse({"base": BASE, "axes": axes, **others})


@given(st.dictionaries(st.sampled_from(["actor_lr", "noise", "ddpg.tau"]), axis, min_size=1, max_size=2), counts)
def test_every_combination_is_a_member_once(axes, seeds):
    asked = {"sample_seed": 0, "fixed": {"episodes": 100}, "axes": {**axes, "seed": {"count": seeds}}}
    made = spec.parse({"base": BASE, **asked})
    members = made.members
    wanted = list(itertools.product(*(axis.values for axis in made.axes.values())))
    assert [tuple(m.settings.values()) for m in members] == wanted
    assert len(set(wanted)) == len(wanted) and [m.name for m in members] == [f"m{i:04}" for i in range(len(wanted))]
    for member in members:
        flat = member.config.flat()
        assert flat["train.episodes"] == 100 and all(flat[name] == v for name, v in member.settings.items())
    kept = spec.parse(tomllib.loads(made.dumps()))  # It is the same without the base's file.
    assert kept.same_as(made) and kept.members == members


@given(anything)
def test_whatever_an_axis_says_is_read_or_refused(anything):
    try:
        assert parse({"noise": anything}, sample_seed=0).members
    except UserError as error:
        assert "noise" in str(error) and "\n" not in str(error)


def test_random_values_depend_on_the_seed_and_their_own_axis_alone():
    drawn = {"log_uniform": [1e-4, 1e-2], "count": 3}
    values = lambda axes, seed: parse(axes, sample_seed=seed).axes["ddpg.actor_lr"].values
    first = values({"actor_lr": drawn}, 0)
    assert first == values({"noise": {"uniform": [0, 1], "count": 2}, "actor_lr": drawn}, 0)
    assert first != values({"actor_lr": drawn}, 1) and all(1e-4 <= v <= 1e-2 for v in first)


def test_ranges_have_both_ends():
    assert parse({"heads": {"range": [2, 8, 2]}}).axes["ddpg.heads"].values == (2, 4, 6, 8)
    assert parse({"noise": {"range": [0.1, 0.3, 0.1]}}).axes["ddpg.noise"].values == pytest.approx((0.1, 0.2, 0.3))


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"axes": {"actor_rl": [1e-3]}}, "unknown setting 'actor_rl': did you mean 'actor_lr'?"),
        ({"axes": {}}, "has [axes] with one at least"),
        ({"axes": {"actor_lr": []}}, "axis 'actor_lr' is empty"),
        ({"axes": {"seed": {"count": 0}}}, "axis 'seed' is empty"),
        ({"axes": {"noise": {"range": [1, 0, 0.1]}}}, "axis 'noise' is empty"),
        ({"axes": {"actor_lr": [1e-3], "ddpg.actor_lr": [1e-2]}}, "ddpg.actor_lr is set twice"),
        ({"axes": {"actor_lr": [1e-3]}, "fixed": {"actor-lr": 1e-2}}, "ddpg.actor_lr is set twice"),
        ({"axes": {"actor_lr": [1e-3]}, "fixed": {"noise": 0, "ddpg": {"noise": 1}}}, "ddpg.noise is set twice"),
        ({"axes": {"actor_lr": [1e-3, 1e-3]}}, "axis 'ddpg.actor_lr' has 0.001 twice"),
        ({"axes": {"actor_lr": [1e-3, -1.0]}}, "ddpg.actor_lr = -1.0"),
        ({"axes": {"heads": [2.5]}}, "ddpg.heads = 2.5"),
        ({"axes": {"noise": {"uniform": [0, 1], "count": 2}}}, "is random: say sample_seed = 0"),
        ({"axes": {"noise": {"uniform": [1, 0], "count": 2}}, "sample_seed": 0}, "should be [low, high]"),
        ({"axes": {"seed": {"count": 2**31}}}, "count = 2147483648 is more than 100000"),
        ({"axes": {"noise": {"range": [-1e308, 1e308, 1e-9]}}}, "has more than 100000 values"),
        ({"axes": {"noise": {"range": [0, 10**400, 1]}}}, "should be 3 numbers"),
        ({"axes": {"noise": {"log_uniform": [0, 1], "count": 2}}, "sample_seed": 0}, "[low, high], above 0"),
        ({"axes": {"noise": {"uniform": [0, 1]}}, "sample_seed": 0}, "say how many values"),
        ({"axes": {"noise": {"count": 3}}}, "a count alone is for seeds"),
        ({"axes": {"noise": 3}}, "give a list, or one of"),
        ({"axes": {"noise": [0.1]}, "grid": {}}, "unknown table 'grid'"),
        ({"axes": {"noise": [0.1]}, "search": {"methods": "tpe"}}, "did you mean 'method'?"),
        ({"axes": {"noise": [0.1]}, "search": {"method": "grid"}}, "search.method = 'grid'"),
        ({"axes": {"noise": [0.1]}, "search": {}}, "a search is random"),
        ({"axes": {"seed": {"count": 400}, "noise": {"range": [0, 1, 0.001]}}}, "members are more than"),
        ({"variants": {"a": {"noise": 0}}, "axes": {"noise": [0.1]}}, "it is an axis, and set by variant 'a'"),
        ({"variants": {"a": {"nose": 0}}}, "did you mean 'noise'?"),
        ({"variants": {"a": 3}}, "it should be a table [variants]"),
        ({"variants": {"a": {"noise": -1}}}, "ddpg.noise = -1"),
        ({"base": "nowhere.toml", "axes": {"noise": [0.1]}}, "no experiment 'nowhere.toml'"),
        ({"base": 3, "axes": {"noise": [0.1]}}, "base = 3"),
    ],
)
def test_bad_sweeps_are_refused_in_one_line(asked, words):
    assert words in said(lambda: spec.parse({"base": BASE, **asked}))


def test_a_sweep_is_no_experiment_nor_the_other_way_round(tmp_path):
    assert "is a sweep, not an experiment" in said(lambda: load_config("sweep_smoke.toml"))
    assert "unknown table 'env' of a sweep" in said(lambda: spec.read("kinematic.toml"))
    assert "no sweep 'nowhere.toml'" in said(lambda: spec.read("nowhere.toml"))
    (tmp_path / "bad.toml").write_text("axes = ")
    assert "is not valid TOML" in said(lambda: spec.read(tmp_path / "bad.toml"))


def test_every_sweep_that_ships_can_be_read():
    names = [name for name in files.shipped("experiments", ".toml") if name not in config.shipped_experiments()]
    assert "sweep_smoke.toml" in names
    assert all(spec.read(name).members or spec.read(name).search for name in names)


def test_members_that_differ_by_numbers_and_seeds_are_one_program():
    members = parse({"actor_lr": [1e-3, 1e-2], "heads": [2, 4], "seed": {"count": 2}}).members
    found = groups.grouped(members)
    assert [{m.settings["ddpg.heads"] for m in group.members} for group in found] == [{2}, {4}]
    assert [len(group.members) for group in found] == [4, 4]
    assert groups.chunk_size(found[0], 1, free=10 * found[0].member_bytes) == 4
    assert groups.chunk_size(found[0], 2, free=6 * found[0].member_bytes) == 2
    assert "choose fewer workers or a smaller replay_capacity" in said(lambda: groups.chunk_size(found[0], 1, free=9))


def test_a_base_may_be_a_configuration_or_its_sections():
    axes = {"noise": [0.1, 0.2]}
    sections = tomllib.loads(config.dumps(BASE))
    assert spec.parse({"base": sections, "axes": axes}).same_as(parse(axes))
    assert spec.parse({"base": "kinematic.toml", "axes": axes}).members == parse(axes).members


def test_variants_are_an_axis_of_named_settings():
    variants = {"the recipe": {}, "no noise": {"noise": 0, "final_noise": 0}, "one head": {"heads": 1}}
    made = parse({"seed": {"count": 2}}, variants=variants)
    assert [(m.settings["variant"], m.settings["train.seed"]) for m in made.members] == [
        (name, seed) for name in variants for seed in (0, 1)
    ]
    found = {m.settings["variant"]: m.config.ddpg for m in made.members}
    assert found["the recipe"] == BASE.ddpg and found["no noise"].noise == 0 and found["one head"].heads == 1
    kept = spec.parse(tomllib.loads(made.dumps()))
    assert kept.same_as(made) and kept.members == made.members
    assert not made.same_as(parse({"seed": {"count": 2}}, variants=dict(reversed(variants.items()))))
