"""What is written can be read, by whoever reads JSON."""

import json
import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from arm5dof.envs.metrics import Error
from arm5dof.runtime import files
from arm5dof.training import curves

LEAVES = st.none() | st.booleans() | st.integers() | st.floats() | st.text()
VALUES = st.recursive(LEAVES, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner), max_leaves=20)


def refuse(constant: str) -> None:
    raise AssertionError(f"{constant} is no JSON")


def finite(value: object) -> object:
    match value:
        case dict():
            return {name: finite(inner) for name, inner in value.items()}
        case list():
            return [finite(inner) for inner in value]
        case float() if not math.isfinite(value):
            return None
    return value


@given(VALUES)
def test_json_is_json(value):
    assert json.loads(files.to_json(value), parse_constant=refuse) == finite(value)


def test_evaluations_of_physics_that_blew_up_are_json(tmp_path):
    counters = {"steps": 3, "episodes": 1, "env_steps": 6, "updates": 0, "targets": 9, "means": {"episode": math.inf}}
    curves.write_evaluations(tmp_path, [{**counters, "episode": Error().summary(np.array([math.inf]))}])
    json.loads((tmp_path / curves.EVALUATIONS).read_text(), parse_constant=refuse)
    (found,) = curves.read_evaluations(tmp_path, {"episode": Error()})
    assert found["steps"] == 3 and math.isnan(found["episode"]["median_mm"]) and found["episode"]["within"]["1"] == 0
