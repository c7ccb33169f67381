"""Throughput and time to accuracy of `experiments/gpu.toml` on one GPU, for several numbers of environments.

    python experiments/gpu.py                              4,096 to 65,536 environments, into experiments/results/gpu.md
    python experiments/gpu.py --envs 64 --episode-length 8     to see that it works; nothing is written

Each number of environments runs in a process of its own, which has the whole GPU. With `mujoco-mjx[warp]` installed,
bare `mjx.step` is timed with that back end, too.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

RESULTS = Path(__file__).parent / "results"
ENVS = [4096, 16384, 65536]
GOALS = {"95.5 % within 10 mm after, s": ("10", 95.5), "99.9 % within 5 mm after, s": ("5", 99.9)}


def measure(envs: int, length: int) -> dict[str, float | str]:
    """Control steps per second with learning on and off, and seconds of training, once compiled, to each goal."""
    import jax

    from arm5dof import load_config
    from arm5dof.training import evaluate, loop

    size = dict.fromkeys(("num_envs", "episodes", "evaluate_every", "checkpoint_every"), envs)
    settings = load_config("gpu.toml", **size, episode_length=length)
    trainer = loop.make_trainer(settings)
    ddpg, steps = settings.ddpg, settings.train.epoch_steps
    collect = lambda t: jax.lax.scan(lambda t, _: (trainer.agent.collect(ddpg, t)[0], None), t, None, steps)[0]
    collect = jax.jit(collect, donate_argnums=0)

    trainer.start()
    trainer.advance()  # Compiles.
    found: dict[str, float | str] = {}
    evaluate.evaluate(trainer.policy(), 10_000)
    trainer.start()
    seconds = 0.0
    while not trainer.finished:
        start = time.perf_counter()
        trainer.advance()
        seconds += time.perf_counter() - start
        missing = [name for name in GOALS if name not in found]
        if missing:
            within = evaluate.evaluate(trainer.policy(), 10_000)["one_shot"]["within"]
            found |= {name: seconds for name in missing if within[GOALS[name][0]] >= GOALS[name][1]}
    found |= {name: "not reached" for name in GOALS if name not in found}
    found["control steps/s, learning"] = trainer.counters.env_steps / seconds
    found["updates/s"] = trainer.counters.updates / seconds

    state = jax.block_until_ready(collect(trainer.state))
    start = time.perf_counter()
    for _ in range(10):
        state = collect(state)
    jax.block_until_ready(state)
    found["control steps/s, not learning"] = 10 * steps * envs / (time.perf_counter() - start)
    return found | bare(envs)


def bare(envs: int, steps: int = 20) -> dict[str, float | str]:
    """Physics steps per second of `vmap(mjx.step)` by each of MJX's back ends that is installed."""
    import jax

    from arm5dof.arm import load_arm
    from arm5dof.runtime.mjx import mjx

    loaded = load_arm("reach.xml")
    q = loaded.sample(jax.random.key(0), (envs,))
    place = lambda q, d: d.replace(qpos=d.qpos.at[loaded.qpos].set(q))
    found: dict[str, float | str] = {}
    for back_end in ("jax", "warp"):
        name = f"bare mjx.step/s, {back_end}"
        try:
            model = mjx.put_model(loaded.mj_model, impl=back_end)
            step = jax.vmap(lambda d, model=model: mjx.step(model, d))
            start = lambda q, impl=back_end: place(q, mjx.make_data(loaded.mj_model, impl=impl))
            data = jax.jit(jax.vmap(start))(q)
            run = jax.jit(lambda d, step=step: jax.lax.scan(lambda d, _: (step(d), None), d, None, steps)[0])
            jax.block_until_ready(run(data))
            before = time.perf_counter()
            jax.block_until_ready(run(data))
            found[name] = envs * steps / (time.perf_counter() - before)
        except (ImportError, RuntimeError, NotImplementedError) as error:
            found[name] = f"not measured: {str(error).splitlines()[0]}"
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", type=int, nargs="*", default=ENVS)
    parser.add_argument("--episode-length", type=int, default=160)
    parser.add_argument("--alone", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.alone:
        print(json.dumps(measure(arguments.envs[0], arguments.episode_length)))
        return
    columns = {}
    for envs in arguments.envs:
        command = [sys.executable, __file__, "--alone", "--envs", str(envs)]
        done = subprocess.run([*command, "--episode-length", str(arguments.episode_length)], stdout=subprocess.PIPE)
        if done.returncode:
            raise SystemExit(f"{envs} environments: the process ended with status {done.returncode}")
        columns[envs] = json.loads(done.stdout.splitlines()[-1])
    text = markdown(columns)
    print(text)
    if arguments.envs == ENVS and arguments.episode_length == 160:
        from arm5dof.runtime import files

        files.write_text(RESULTS / "gpu.md", text)


def markdown(columns: dict[int, dict[str, float | str]]) -> str:
    from arm5dof.training import run

    show = lambda value: value if isinstance(value, str) else f"{value:,.4g}" if value < 1e4 else f"{value:,.0f}"
    lines = [
        "# One GPU",
        "",
        f"{run.device()}. Command: `python experiments/gpu.py`.",
        "",
        "| environments | " + " | ".join(f"{envs:,}" for envs in columns) + " |",
        "| --- |" + " ---: |" * len(columns),
    ]
    names = next(iter(columns.values()))
    lines += [f"| {name} | " + " | ".join(show(found[name]) for found in columns.values()) + " |" for name in names]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
