"""The XLA flag is set where it is known, and never over the user's own."""

import os
import subprocess
import sys
from importlib import metadata

import jax
import pytest
from helpers.errors import said

from arm5dof import load_config, make_env
from arm5dof.runtime import xla


@pytest.mark.parametrize("version", ["0.8.3", "0.9.2", "0.10.2", "0.10.2.dev20260101"])
def test_known_versions_get_the_flag(version):
    assert xla.flags("", version) == xla.FUSION_EMITTERS
    assert xla.flags("--xla_dump_to=x", version) == f"--xla_dump_to=x {xla.FUSION_EMITTERS}"


@pytest.mark.parametrize("version", ["0.4.30", "0.8.2", "0.10.3", "0.11.2", "1.0"])
def test_unknown_versions_are_left_alone(version):
    assert xla.flags("--xla_dump_to=x", version) == "--xla_dump_to=x"


def test_the_users_own_setting_wins():
    assert xla.flags("--xla_cpu_use_fusion_emitters=true", "0.10.2") == "--xla_cpu_use_fusion_emitters=true"


@pytest.mark.parametrize("own", ["", "--xla_cpu_use_fusion_emitters=true"])
def test_jax_starts_with_what_was_set(own):
    code = "import os, jax; from arm5dof import Arm; jax.devices(); print(os.environ.get('XLA_FLAGS', ''))"
    environment = {**os.environ, "XLA_FLAGS": own}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert ("=true" in done.stdout) == bool(own)


def test_one_program_may_choose_for_itself():
    code = (
        "import arm5dof, jax, jax.numpy as jnp; from arm5dof.runtime import xla;"
        "print(xla.fusion_emitters(), jax.jit(jnp.sin, compiler_options=xla.fusion_emitters())(0.0))"
    )
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split()[-1] == "0.0"
    known = xla.flags("", metadata.version("jaxlib")) != ""
    assert ("True" in done.stdout) == known


@pytest.mark.parametrize("first", ["import jax;", ""])
def test_programs_are_kept_in_the_cache_folder(first, tmp_path):
    """Whether or not JAX was imported before; where the user wants it, and not at all if they do not."""
    code = (
        f"{first}from arm5dof.runtime import xla; xla.enable_compilation_cache(); import jax;"
        "print(jax.config.jax_compilation_cache_dir, xla.programs_folder())"
    )
    unset = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}

    def folders(**environment: str) -> list[str]:
        done = subprocess.run(
            [sys.executable, "-c", code], env={**unset, **environment}, capture_output=True, text=True, check=True
        )
        return done.stdout.split()

    default = str(tmp_path / "arm5dof" / "xla")
    assert folders(XDG_CACHE_HOME=str(tmp_path)) == [default, f"{default}/traced"]
    assert folders(JAX_COMPILATION_CACHE_DIR="/somewhere") == ["/somewhere", "/somewhere/traced"]
    assert folders(JAX_ENABLE_COMPILATION_CACHE="false")[1] == "None"


NO_HOME = """
import pathlib, sys

def homeless(cls):
    raise RuntimeError("Could not determine home directory.")

pathlib.Path.home = classmethod(homeless)
from arm5dof.runtime import xla
xla.enable_compilation_cache()
import matplotlib
print(xla.programs_folder(), matplotlib.get_cachedir())
"""


@pytest.mark.parametrize("given", ["", "relative"])
def test_a_user_without_a_home_has_a_cache(given, tmp_path):
    unset = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "MPL", "XDG_"))}
    environment = {**unset, "XDG_CACHE_HOME": given, "TMPDIR": str(tmp_path)}
    command = [sys.executable, "-c", NO_HOME]
    done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert all(path.startswith(f"{tmp_path}/cache-") for path in done.stdout.split()), done.stdout
    assert not (tmp_path / "relative").exists()


def test_what_jax_is_set_to_is_refused_where_it_does_not_work():
    xla.check_numbers()
    xla.check_platform()
    with jax.enable_x64(True):
        assert "JAX_ENABLE_X64" in said(xla.check_numbers)
    with jax.numpy_rank_promotion("raise"):
        assert "JAX_NUMPY_RANK_PROMOTION" in said(lambda: make_env(load_config("kinematic.toml")))
    with jax.numpy_dtype_promotion("strict"):
        assert "JAX_NUMPY_DTYPE_PROMOTION" in said(xla.check_numbers)
    with jax.disable_jit():
        assert "JAX_DISABLE_JIT" in said(xla.check_numbers)
    with jax.default_prng_impl("rbg"):
        assert "JAX_DEFAULT_PRNG_IMPL" in said(xla.check_numbers)
    with jax.threefry_partitionable(False):
        assert "JAX_THREEFRY_PARTITIONABLE" in said(xla.check_numbers)
    with jax.transfer_guard("disallow"):
        assert "JAX_TRANSFER_GUARD" in said(xla.check_numbers)


@pytest.mark.parametrize(
    "name, value, expected",
    [
        ("JAX_PLATFORMS", "rocm", "JAX_PLATFORMS=rocm: JAX finds no such device here"),
        ("XLA_FLAGS", "--xla_no_such_flag", "XLA_FLAGS=--xla_no_such_flag ends XLA (Unknown flag in XLA_FLAGS"),
        ("XLA_FLAGS", "no-such-file", "XLA_FLAGS=no-such-file ends XLA (Could not open file"),
        ("JAX_ENABLE_X64", "maybe", "mend or unset JAX_ENABLE_X64=maybe"),
        ("MUJOCO_GL", "nonsense", "mend or unset MUJOCO_GL=nonsense"),
    ],
)
def test_what_the_environment_asks_for_in_vain_is_one_line(name, value, expected):
    start = [sys.executable, "-m", "arm5dof", "arm", "arm7.xml"]
    done = subprocess.run(start, env={**os.environ, name: value}, capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr.startswith("arm5dof: ") and done.stderr.count("\n") == 1
    assert expected in done.stderr


def test_a_file_of_flags_is_left_alone():
    assert xla.flags("flags.txt", "0.8.3") == "flags.txt"
