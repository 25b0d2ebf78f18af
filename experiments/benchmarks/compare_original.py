"""Speed beside the original's, in one run: same task, states and actions, in turn on the same machine.

    python experiments/benchmarks/compare_original.py --original ~/original/bin/python --config ~/original-config

README.md says how to make the original's environment. `--config` is the original's `LIBERO_CONFIG_PATH`; its
`config.yaml` names `assets`, `bddl_files` and `init_states`.

Both sides take turns, so that neither has the quieter machine. Each control step counts with the fastest of its
repeats, everything else with its fastest call. Physics is pinned to one core where the table says so; pictures may use
all cores, as they do on either side. Run it on an idle machine.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from bare_mujoco import BareMujoco, best
from comparison_table import BATCH, ROWS, THREADS, Figures, judged, line, machine
from original_process import Original, one_core

from libero_env.assets.pack import Pack, select_pack
from libero_env.envs.batch import BatchEnv
from libero_env.envs.env import LiberoEnv
from libero_env.init_states.pickles import read_states

PHYSICS_STEPS, CAMERA_STEPS = 100, 50
FOREVER = 10**6  # steps, no episode ends by its length


def smooth_actions(num: int) -> np.ndarray:
    """Actions (num, 7) in slow waves, the gripper closing and opening; always the same."""
    rng, t = np.random.default_rng(0), np.arange(num)[:, None] / 20.0
    waves = [np.sin(2 * np.pi * (rng.uniform(0.1, 0.8, 7) * t + rng.uniform(0, 1, 7))) for _ in range(3)]
    actions = np.mean(waves, axis=0)
    actions[:, 6] = np.sign(actions[:, 6])
    return actions


def step_times(env: LiberoEnv | BatchEnv, actions: np.ndarray) -> list[float]:
    """Seconds of each control step."""
    times = []
    for action in actions:
        begin = time.perf_counter()
        env.step(action)
        times.append(time.perf_counter() - begin)
    return times


def of_best(rounds: list[list[float]]) -> float:
    """Mean over steps of the fastest repeat of each, s."""
    return float(np.min(rounds, axis=0).mean())


class Comparison:
    """The measurements; each method gives the figures of one part of the table.

    Args:
        python, config: the original's interpreter and configuration.
        task: its id here.
        rounds: repeats of what is fast; the slow things have half as many.
        lod: triangles that each visual mesh of the original's pack is simplified to.
        resets: how many resets the memory is watched over.
    """

    def __init__(self, python: str, config: Path, task: str, rounds: int, lod: int, resets: int):
        self.python, self.config, self.task, self.resets_watched = python, config, task, resets
        self.rounds, self.slow_rounds = rounds, max(rounds // 2, 2)
        self.original = Original(python, config)
        self.about = self.original("about")
        self.packs: dict[str, Pack | str] = {
            "camera step": "builtin",
            "simplified camera step": select_pack(self.about["assets"], lod),
        }
        env = self.env(cameras=())
        scene, name = env.scene, f"{env.task.suite}/{env.task.name}"
        self.poses = scene.fixture_poses
        self.fixtures = {f"{n}_main": p.tolist() for n, p in zip(scene.fixtures, self.poses, strict=True)}
        self.file = f"{self.about['bddl_files']}/{name}.bddl"
        self.states = read_states(f"{self.about['init_states']}/{name}.pruned_init")
        self.notes: dict[str, Any] = {}
        env.close()

    def env(self, assets: Pack | str = "builtin", **arguments: Any) -> LiberoEnv:
        """Ours."""
        return LiberoEnv(self.task, assets=assets, horizon=FOREVER, **arguments)

    def start(self, env: LiberoEnv, i: int = 0) -> None:
        """Begin an episode from the original's i-th state, fixtures where the other side has them."""
        env.simulations.fixtures[0] = self.poses
        env.set_state(self.states[i])

    def start_all(self, batch: BatchEnv, env: LiberoEnv) -> None:
        """The same in each simulation of a batch, from different states; `env` is used to make them."""
        for i in range(batch.num_envs):
            self.start(env, i % len(self.states))
            batch.set_state(i, env.get_state())

    def theirs(self, name: str, actions: np.ndarray) -> dict[str, Any]:
        """Their steps from the first state."""
        self.original("put", name=name, state=self.states[0].tolist(), fixtures=self.fixtures)
        return self.original("steps", name=name, actions=actions.tolist())

    def ours(self, env: LiberoEnv, actions: np.ndarray) -> list[float]:
        """Our steps from the first state."""
        self.start(env)
        return step_times(env, actions)

    def physics(self) -> Figures:
        """Control steps without cameras: one simulation on one core, and many on two threads."""
        actions, other, one, many = smooth_actions(PHYSICS_STEPS), [], [], []
        self.original("build", name="physics", file=self.file, cameras=False)
        self.original("reset", name="physics")
        env = self.env(cameras=())
        batch = BatchEnv(self.task, BATCH, num_threads=THREADS, cameras=(), assets="builtin", horizon=FOREVER)
        self.theirs("physics", actions[:5]), self.ours(env, actions[:5])  # both compile
        for _ in range(self.rounds):
            with one_core(self.original.pid):
                found = self.theirs("physics", actions)
                other.append(found["s"])
                one.append(self.ours(env, actions))
            contacts = env.simulations.data(0).ncon
            self.start_all(batch, env)
            many.append(step_times(batch, np.repeat(actions[:, None], BATCH, axis=1)))
        self.notes["contacts at the end"] = {"original": found["contacts"], "ours": int(contacts)}
        self.notes["grip sites apart, original's pack in both, m"] = self._apart(actions, found["grip"])
        env.close()
        batch.close()
        return {"original step": of_best(other), "step": of_best(one), "batch step": of_best(many) / BATCH}

    def pictures(self) -> Figures:
        """Control steps with two cameras of 128x128: our pack, the original's on both sides, and many in one."""
        actions, times = smooth_actions(CAMERA_STEPS), {"original camera step": [], "batch": []}
        self.original("build", name="cameras", file=self.file, cameras=True)
        self.original("reset", name="cameras")
        envs = {name: self.env(pack) for name, pack in self.packs.items()}
        batch = BatchEnv(self.task, BATCH, num_threads=THREADS, assets="builtin", horizon=FOREVER)
        self.theirs("cameras", actions[:5])
        for env in envs.values():
            self.ours(env, actions[:5])
        for _ in range(self.slow_rounds):
            times["original camera step"].append(self.theirs("cameras", actions)["s"])
            for name, env in envs.items():
                times.setdefault(name, []).append(self.ours(env, actions))
            self.start_all(batch, envs["camera step"])
            times["batch"].append(step_times(batch, np.repeat(actions[:10, None], BATCH, axis=1)))
        for env in (*envs.values(), batch):
            env.close()
        figures = {name: of_best(found) for name, found in times.items()}
        figures["batch camera step"] = figures.pop("batch") / BATCH
        return figures

    def resets(self) -> Figures:
        """Resets with both pictures drawn; theirs to a stored state is a reset and then the state, as published."""
        env, state = LiberoEnv(self.task, assets="builtin"), self.states[1].tolist()
        ask = lambda do, **more: self.original(do, name="resets", **more)["s"]  # noqa: E731
        ask("build", file=self.file, cameras=True), ask("reset"), env.reset(options={"init_state": 0})
        rows = [
            (
                ask("reset", state=state),
                ask("put", state=state),
                ask("reset"),
                best(lambda: env.reset(options={"init_state": 1}), 10),
                best(lambda i=i: env.reset(seed=i), 1),
            )
            for i in range(self.slow_rounds)
        ]
        env.close()
        names = ("original reset", "original put", "original placement", "reset", "placement")
        return dict(zip(names, np.min(rows, axis=0).tolist(), strict=True))

    def construction(self) -> Figures:
        """Fresh processes: imports, construction, and the first reset with pictures."""
        code = (
            "import time; a = time.perf_counter(); from libero_env.envs.env import LiberoEnv; b = time.perf_counter()\n"
            f"env = LiberoEnv('{self.task}', assets='builtin'); c = time.perf_counter()\n"
            "env.reset(options={'init_state': 0}); print(b - a, c - b, time.perf_counter() - c)"
        )
        other, own = [], []
        for _ in range(self.slow_rounds + 1):  # the first fills caches
            worker = Original(self.python, self.config)
            imported = worker("about")["import_s"]
            built = worker("build", name="new", file=self.file, cameras=True)["s"]
            other.append([imported, built, worker("reset", name="new", state=self.states[0].tolist())["s"]])
            worker.close()
            own.append(run(code))
        figures = {}
        for side, rows in (("original ", other[1:]), ("", own[1:])):
            imports, build, first = np.min(rows, axis=0).tolist()
            figures |= {
                f"{side}import": imports,
                f"{side}build": build,
                f"{side}import and build": imports + build,
                f"{side}build and reset": build + first,
            }
        return figures

    def limits(self) -> Figures:
        """What MuJoCo itself takes, from the same states: 25 steps, and drawing."""
        steps, frames = [], []
        physics, env = self.env(cameras=()), self.env()
        bare, images = BareMujoco(env), env.observer.empty_images()
        env.render_images = False
        for _ in range(self.rounds):
            self.start(physics)
            with one_core():
                steps.append(
                    [(bare.step(physics), *step_times(physics, a[None])) for a in smooth_actions(100)]
                )
            self.start(env)
            frames.append([])
            for action in smooth_actions(CAMERA_STEPS // 2):
                env.step(action)
                env.observer.render_cameras([0], images)  # from here on its context is the current one
                mine = best(lambda: env.observer.render_cameras([0], images), 2)
                frames[-1].append((mine, *bare.draw(env)))
        for made in (bare, physics, env):
            made.close()
        bare_steps, step = np.min(steps, axis=0).mean(axis=0).tolist()
        mine, drawing, reading = np.min(frames, axis=0).mean(axis=0).tolist()
        return {
            "bare steps": bare_steps,
            "step beside bare": step,
            "drawing": mine,
            "bare drawing": drawing,
            "bare drawing and reading": reading,
        }

    def memory(self) -> Figures:
        """Resident memory in a fresh process: after fifty resets with pictures, and after many more."""
        code = (
            "import os; from libero_env.envs.env import LiberoEnv\n"
            "page = os.sysconf('SC_PAGE_SIZE') / 2**20\n"
            "used = lambda: int(open('/proc/self/statm').read().split()[1]) * page\n"
            f"env = LiberoEnv('{self.task}', assets='builtin')\n"
            "for i in range(50): env.reset(options={'init_state': i})\n"
            "before = used()\n"
            f"for i in range({self.resets_watched}): env.reset(options={{'init_state': i % 50}})\n"
            "print(before, used())"
        )
        before, after = run(code)
        self.notes["memory, MB"] = {"before": before, f"after {self.resets_watched} resets": after}
        return {"growth": after - before}

    def _apart(self, actions: np.ndarray, grip: list[float]) -> float:
        """How far our grip site is from theirs after the same actions, with their pack in both, m."""
        env = self.env(self.packs["simplified camera step"], cameras=())
        self.ours(env, actions)
        found = env.observer.state()["ee_pos"][0]
        env.close()
        return float(np.linalg.norm(found - grip))


def run(code: str) -> list[float]:
    """The numbers that a fresh Python process prints."""
    found = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, check=True, text=True)
    return [float(x) for x in found.stdout.split()]


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--original", required=True, help="Python interpreter of the original's environment")
    parser.add_argument("--config", type=Path, required=True, help="the original's LIBERO_CONFIG_PATH")
    parser.add_argument("--task", default="libero_goal/3")
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument(
        "--lod", type=int, default=1000, help="triangles of a visual mesh of the original's pack"
    )
    parser.add_argument(
        "--only", nargs="+", choices=list(ROWS), default=list(ROWS), help="parts of the table"
    )
    parser.add_argument("--quick", action="store_true", help="two rounds and 100 resets, for a look")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    return parser.parse_args()


def main() -> None:
    """Measures, prints the table, and writes it."""
    args = arguments()
    os.environ.setdefault("MUJOCO_GL", "egl")
    host, rounds, resets = machine(), 2 if args.quick else args.rounds, 100 if args.quick else 1000
    comparison = Comparison(args.original, args.config, args.task, rounds, args.lod, resets)
    versions = {"here": mujoco.__version__, "original": comparison.about["versions"]}
    print(
        f"{args.task}, {rounds} rounds, MuJoCo {versions['here']}; the original with {versions['original']}"
    )
    print(
        f"{'ms':52} {'original':>10} {'here':>10} {'ratio':>8} {'target':>9}   (at the limits: bare MuJoCo)"
    )
    figures, rows = {}, []
    for part in args.only:
        figures |= getattr(comparison, part)()
        rows += [judged(row, figures) for row in ROWS[part]]
        print("\n".join(line(row) for row in rows[-len(ROWS[part]) :]), flush=True)
    comparison.original.close()
    print(json.dumps(comparison.notes))
    found = {
        "task": args.task,
        "rounds": rounds,
        "lod": args.lod,
        "mujoco": versions,
        "machine": host,
        "load_after": os.getloadavg(),
        "seconds": figures,
        "rows": rows,
        "notes": comparison.notes,
    }
    args.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
