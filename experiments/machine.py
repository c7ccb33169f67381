"""How fast the parts run on this machine, each beside the bare thing it is made of.

    python experiments/machine.py                 everything, into experiments/results/machine.md and .json
    python experiments/machine.py env update      some of it, printed only

Each figure is the median of several repetitions in one process; ratios are of figures from one process. Run it while
nothing else runs.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

RESULTS = Path(__file__).parent / "results"
REPEATS = 5


def seconds(call: Callable[[], object], repeats: int = REPEATS) -> float:
    """Median time of a call whose result is waited for; one call beforehand compiles."""
    import jax

    jax.block_until_ready(call())
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def reach(dynamics: str = "servo"):
    from arm5dof.arm import load_arm
    from arm5dof.envs.reach import Reach, ReachConfig

    return Reach(ReachConfig(dynamics=dynamics), load_arm("reach.xml"))


def env(batch: int = 1024, steps: int = 20) -> dict[str, float]:
    """Physics steps per second of the servo environment, resets and observations included, and of bare
    `vmap(mjx.step)` in a `scan`."""
    import jax

    from arm5dof.envs import VectorEnv
    from arm5dof.envs.physics import FIELDS
    from arm5dof.runtime.mjx import mjx

    task = reach()
    substeps, model = task.config.substeps, task.arm.mjx_model
    vector = VectorEnv(task, task.config.episode_length)
    state = jax.jit(vector.reset)(jax.random.split(jax.random.key(0), batch))
    actions = jax.random.uniform(jax.random.key(1), (steps, batch, task.action_size), minval=-1.0, maxval=1.0)
    ours = jax.jit(lambda state, actions: jax.lax.scan(lambda s, a: (vector.step(s, a), None), state, actions)[0])
    bare_step = jax.vmap(lambda data: mjx.step(model, data))
    bare = jax.jit(lambda data: jax.lax.scan(lambda d, _: (bare_step(d), None), data, None, steps * substeps)[0])
    kept = {name: getattr(state.data, name) for name in FIELDS}
    data = jax.jit(jax.vmap(lambda kept: mjx.make_data(model).replace(**kept)))(kept)
    total = batch * steps * substeps
    # In turns, so that both see the same machine.
    pairs = [(seconds(lambda: bare(data), 1), seconds(lambda: ours(state, actions), 1)) for _ in range(REPEATS)]
    return {
        "envs": batch,
        "bare mjx.step, steps/s": total / statistics.median(b for b, _ in pairs),
        "servo environment, physics steps/s": total / statistics.median(o for _, o in pairs),
        "ratio": statistics.median(b / o for b, o in pairs),
    }


def flag(batch: int = 1024, steps: int = 50) -> dict[str, float]:
    """Steps per second of bare `vmap(mjx.step)` in this process, whatever XLA_FLAGS says."""
    import jax

    from arm5dof.runtime.mjx import mjx

    model = reach().arm.mjx_model
    start = jax.jit(jax.vmap(lambda ctrl: mjx.make_data(model).replace(ctrl=ctrl)))
    data = start(jax.random.uniform(jax.random.key(0), (batch, model.nu), minval=-1.0, maxval=1.0))
    step = jax.vmap(lambda data: mjx.step(model, data))
    run = jax.jit(lambda data: jax.lax.scan(lambda d, _: (step(d), None), data, None, steps)[0])
    return {"steps/s": batch * steps / seconds(lambda: run(data))}


def update() -> dict[str, float]:
    """A gradient step beside the matrix products it is made of, in their shapes, one after another."""
    import jax
    import jax.numpy as jnp

    from arm5dof import load_config
    from arm5dof.ddpg import DDPG
    from arm5dof.runtime import xla

    config, count = load_config("reach.toml").ddpg, 512
    agent = DDPG(reach("kinematic"), config, num_envs=64, episode_length=160, total_steps=1000)
    training = jax.jit(agent.init)(config, jax.random.key(0))
    training = jax.jit(lambda t: agent.collect(config, t)[0])(training)
    replay = training.replay
    batches = replay.read(replay.sample(jax.random.key(1), (count, config.batch_size)))
    batches = (batches, agent.critic_inputs(config, batches))
    scan = lambda t, b: jax.lax.scan(lambda t, b: agent.update(config, t, *b), t, b)[0].networks
    learn = jax.jit(scan, compiler_options=xla.effort(2))

    rows, heads = config.batch_size, config.heads
    actor = _layers(training.networks.actor)
    critic = _layers(training.networks.critic)
    # Forward and both halves of backward: the actor on the batch; the critic on its heads' answers, where its weights
    # need no gradient; and the critic on the batch.
    products = _products(actor, rows, 3) + _products(critic, rows * heads, 2) + _products(critic, rows, 3)
    keys = iter(jax.random.split(jax.random.key(2), 2 * len(products)))
    operands = [(jax.random.normal(next(keys), (m, k)), jax.random.normal(next(keys), (k, n))) for m, k, n in products]

    def bare(operands: list) -> jax.Array:
        def step(x: jax.Array, _: None) -> tuple[jax.Array, None]:
            # Each product hangs on the one before, as in a network, by one number that the compiler cannot know.
            for a, b in operands:
                x = (a + x * 0).dot(b)[0, 0] * 1e-6
            return x, None

        return jax.lax.scan(step, jnp.zeros(()), None, count)[0]

    bare = jax.jit(bare, compiler_options=xla.effort(2))
    turns = range(3 * REPEATS)
    pairs = [(seconds(lambda: bare(operands), 1), seconds(lambda: learn(training, batches), 1)) for _ in turns]
    return {
        "matrix products, ms": 1e3 * statistics.median(b for b, _ in pairs) / count,
        "gradient step, ms": 1e3 * statistics.median(u for _, u in pairs) / count,
        "ratio": statistics.median(b / u for b, u in pairs),
        "GFLOP in a step": 2e-9 * sum(m * k * n for m, k, n in products),
    }


def _layers(params: dict) -> list[tuple[int, int]]:
    import jax

    return [leaf.shape for leaf in jax.tree.leaves(params) if leaf.ndim == 2]


def _products(layers: list[tuple[int, int]], rows: int, passes: int) -> list[tuple[int, int, int]]:
    """Shapes (m, k, n) of forward, of the gradient by the inputs, and of that by the weights."""
    shapes = []
    for k, n in layers:
        shapes += [(rows, k, n), (rows, n, k), (k, rows, n)][:passes]
    return shapes


def profile() -> dict[str, float]:
    """What a training step of the default experiment consists of: 50 environments, 128 updates."""
    import jax

    from arm5dof import load_config
    from arm5dof.runtime import xla
    from arm5dof.training import loop

    trainer = loop.make_trainer(load_config("reach.toml"))
    agent, ddpg = trainer.agent, trainer.config.ddpg
    jit = partial(jax.jit, compiler_options=xla.effort(2))
    trainer.start()
    trainer.advance()
    state = trainer.state
    shape = (ddpg.updates_per_step, ddpg.batch_size)
    key = jax.random.key(0)
    collect = jit(agent.collect)

    def draw(t):
        batches, shown = agent.relabel(ddpg, t.replay, t.replay.sample(key, shape), key)
        return batches, agent.critic_inputs(ddpg, batches), shown

    draw = jit(draw)
    batches = draw(state)
    learn = jit(lambda t, b: jax.lax.scan(lambda t, b: agent.update(ddpg, t, *b), t, b))
    epoch = jit(agent.epoch, static_argnums=2)
    steps = trainer.config.train.epoch_steps
    parts = {
        "environments and replay insert, ms": lambda: collect(ddpg, state),
        "sampling and hindsight, ms": lambda: draw(state),
        "updates, ms": lambda: learn(state, batches),
        "a whole step, ms": lambda: epoch(ddpg, state, steps),
    }
    found = {name: 1e3 * seconds(call) for name, call in parts.items()}
    found["a whole step, ms"] /= steps
    return found


def replay() -> dict[str, float]:
    """An insert of 64 and a sample of 64 x 64 transitions, at capacities up to ten million."""
    import jax

    from arm5dof import load_config
    from arm5dof.ddpg import DDPG, Replay, Transition

    config = load_config("reach.toml").ddpg
    agent = DDPG(reach("kinematic"), config, num_envs=64, episode_length=160, total_steps=1000)
    one = jax.jit(lambda key: jax.tree.map(lambda x: x[0], agent.init(config, key).replay.storage))(jax.random.key(0))
    batch: Transition = jax.tree.map(lambda x: jax.numpy.ones((64, *x.shape), x.dtype), one)
    insert = jax.jit(lambda r: r.insert(batch), donate_argnums=0)
    sample = jax.jit(lambda r, key: jax.tree.map(jax.numpy.sum, r.read(r.sample(key, (64, 64)))))
    keys = jax.random.split(jax.random.key(0), 200)
    found = {}
    for capacity in (10_048, 100_032, 1_000_000, 10_000_000):
        create = partial(Replay.create, capacity=capacity, batch=64)
        buffer = insert(jax.jit(create)(one))
        buffer = buffer.replace(size=jax.numpy.int32(capacity))
        start = time.perf_counter()
        for _ in range(1000):
            buffer = insert(buffer)
        jax.block_until_ready(buffer)
        found[f"insert, us, capacity {capacity}"] = 1e3 * (time.perf_counter() - start)
        found[f"sample, us, capacity {capacity}"] = 1e6 / 200 * seconds(lambda b=buffer: [sample(b, k) for k in keys])
        del buffer
    return found


def first_step() -> dict[str, float]:
    """Compile the default experiment's program and take one step of every environment, gradient steps included."""
    from arm5dof import load_config
    from arm5dof.runtime import xla
    from arm5dof.training import loop

    xla.enable_compilation_cache()
    trainer = loop.make_trainer(load_config("reach.toml", epoch_steps=1))
    trainer.start()
    trainer.advance()
    return {}


def bare_step() -> dict[str, float]:
    """Compile one `vmap(mjx.step)` for as many environments and take it."""
    import jax

    from arm5dof.runtime.mjx import mjx

    arm = reach().arm

    def step(q: jax.Array) -> mjx.Data:
        data = mjx.make_data(arm.mjx_model)
        return mjx.step(arm.mjx_model, data.replace(qpos=data.qpos.at[arm.qpos].set(q)))

    jax.block_until_ready(jax.jit(jax.vmap(step))(arm.sample(jax.random.key(0), (50,))))
    return {}


PARTS = {f.__name__: f for f in (env, flag, update, profile, replay, first_step, bare_step)}


def alone(part: str, cache: Path | None = None, **environment: str) -> tuple[dict[str, float], float]:
    """One part in a process of its own, and how long the process took."""
    settings = {"JAX_COMPILATION_CACHE_DIR": str(cache)} if cache else {"JAX_ENABLE_COMPILATION_CACHE": "false"}
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, __file__, part], env={**os.environ, **settings, **environment}, capture_output=True, text=True
    )
    if done.returncode:
        raise SystemExit(done.stderr)
    return json.loads(done.stdout), time.perf_counter() - start


def starts() -> dict[str, float]:
    """Whole processes, from their start to the first gradient steps, against one that compiles `mjx.step` alone."""
    turns = []
    with tempfile.TemporaryDirectory() as folder:
        for i in range(REPEATS):  # In turns, so that all see the same machine.
            cache = Path(folder) / str(i)
            turns.append([alone(*what)[1] for what in (("bare_step",), ("first_step", cache), ("first_step", cache))])
    median = statistics.median
    return {
        "bare mjx.step, s": median(bare for bare, _, _ in turns),
        "cold start, s": median(cold for _, cold, _ in turns),
        "warm start, s": median(warm for _, _, warm in turns),
        "cold / bare": median(cold / bare for bare, cold, _ in turns),
        "warm / cold": median(warm / cold for _, cold, warm in turns),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help="print these and write nothing")
    parts = parser.parse_args().parts
    if parts:
        for part in parts:
            print(json.dumps(PARTS[part]()))
        return
    without = "--xla_cpu_use_fusion_emitters=true"
    tables = {
        "servo environment against bare mjx.step": alone("env")[0],
        "XLA's fusion emitters off": {
            "ours, steps/s": (ours := alone("flag")[0]["steps/s"]),
            "jax's default, steps/s": (default := alone("flag", XLA_FLAGS=without)[0]["steps/s"]),
            "ratio": ours / default,
        },
        "start of a process": starts(),
        "a training step": alone("profile")[0],
        "gradient step": alone("update")[0],
        "replay buffer": alone("replay")[0],
    }
    from arm5dof.runtime import files

    lines = [
        "# The machine's share",
        "",
        f"{platform.machine()} CPU, {os.cpu_count()} cores. Command: `python experiments/machine.py`.",
    ]
    for title, figures in tables.items():
        lines += ["", f"## {title}", "", "| | |", "| --- | ---: |"]
        lines += [f"| {name} | {value:,.4g} |" for name, value in figures.items()]
    text = "\n".join(lines) + "\n"
    print(text)
    RESULTS.mkdir(exist_ok=True)
    files.write_text(RESULTS / "machine.md", text)
    files.write_text(RESULTS / "machine.json", json.dumps(tables, indent=1) + "\n")


if __name__ == "__main__":
    main()
