"""Episodes of LIBERO-Plus' variants beside this package's: pictures of moved cameras, and the arm of robot variants.

It runs where `plus_beside_theirs.py` does, with LIBERO's models as the folder `assets` of LIBERO-Plus, and with this
package's dependencies; both sides then use one MuJoCo.

    PYTHONPATH=. LIBERO_PLUS=FOLDER python experiments/robustness/plus_episodes_beside_theirs.py --assets ASSETS

Of each suite, some robot variants are reset by their code; then the stored initial state is set (`overwritten`) or not
(`skipped`). The arm settles for ten steps and moves for thirty with random actions. Printed are differences of the
seven joints, [rad]: between their start and the variant's pose, between theirs and ours while settling and in all
steps, and between theirs and an arm whose controller has LIBERO's pose, which is what the variant's pose does.

Of each suite, some camera variants are drawn at their start; printed are differences of their picture from ours, and
from that of the base task, in grey levels.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from liberoplus.liberoplus.envs.env_wrapper import ControlEnv, OffScreenRenderEnv

from libero_env.envs.batch import BatchEnv
from libero_env.init_states.store import load_original_states
from libero_env.published import PublishedTask, joint_pose
from libero_env.tasks import get_suite

SUITES = ("libero_plus_spatial", "libero_plus_object", "libero_plus_goal", "libero_plus_10")
SETTLING, MOVING = 10, 30


def actions(seed: int) -> np.ndarray:
    """Return the actions of an episode: an open gripper at rest, then random moves."""
    rng = np.random.default_rng(seed)
    rest = np.tile([0.0] * 6 + [-1.0], (SETTLING, 1))
    moves = np.round(rng.uniform(-32, 32, (MOVING, 7))) / 64
    return np.concatenate([rest, moves])


def fixture_poses(env: ControlEnv) -> dict[str, list[float]]:
    """Return the pose of each fixture, which their reset draws."""
    model, found = env.sim.model, {}
    for name, fixture in env.env.fixtures_dict.items():
        if getattr(fixture, "root_body", None) in model.body_names:
            body = model.body_name2id(fixture.root_body)
            found[name] = [*model.body_pos[body], *model.body_quat[body]]
    return found


def their_arm(task: PublishedTask, moves: np.ndarray) -> tuple[np.ndarray, dict, np.ndarray]:
    """Return the state that their episode starts in, with the fixtures, and the joints after each step."""
    file = task.file.with_name(f"{task.variant.name}.bddl")  # which their environment takes apart
    env = ControlEnv(
        bddl_file_name=str(file),
        use_camera_obs=False,
        has_offscreen_renderer=False,
        has_renderer=False,
        ignore_done=True,
    )
    env.seed(0)
    env.reset()
    if task.robot_state == "overwritten":
        env.set_init_state(load_original_states(task)[0])
    state, fixtures = env.get_sim_state(), fixture_poses(env)
    joints = []
    for move in moves:
        env.step(move)
        joints.append(env.sim.data.qpos[:7].copy())
    env.close()
    return state, fixtures, np.array(joints)


def start_row(env: BatchEnv, state: np.ndarray, fixtures: dict) -> np.ndarray:
    """Return a state with the poses of fixtures as a start of an environment of this package, (1, n)."""
    model = env.scene.model
    poses = [fixtures[name] for name in env.scene.fixtures]
    return np.concatenate([state[: 1 + model.nq + model.nv], np.ravel(poses)])[None]


def compare_pictures(task: PublishedTask, assets: str) -> tuple[int, float]:
    """Return the largest difference of their picture from ours, and its mean difference from the base task's."""
    file = task.file.with_name(f"{task.variant.name}.bddl")
    env = OffScreenRenderEnv(bddl_file_name=str(file), camera_heights=256, camera_widths=256)
    env.seed(0)
    env.reset()
    theirs = env.set_init_state(load_original_states(task)[0])["agentview_image"][::-1].astype(int)
    state, fixtures = env.get_sim_state(), fixture_poses(env)
    env.close()
    found = []
    for drawn in (task, task.base):
        ours = BatchEnv(
            drawn,
            1,
            num_threads=1,
            cameras=("agentview",),
            camera_size=(256, 256),
            assets=assets,
            drawing="faithful",
            robot="robosuite-1.4.1",
        )
        observation, _ = ours.reset(options={"start": start_row(ours, state, fixtures)})
        found.append(np.abs(theirs - observation["agentview_rgb"][0]))
        ours.close()
    return int(found[0].max()), float(found[1].mean())


def our_arm(task, state: np.ndarray, fixtures: dict, moves: np.ndarray, assets: str) -> np.ndarray:
    """Return the joints after each step from the same state."""
    env = BatchEnv(
        task,
        1,
        num_threads=1,
        cameras=(),
        assets=assets,
        robot="robosuite-1.4.1",
        horizon=1000,
        observed="substep",
    )
    env.reset(options={"start": start_row(env, state, fixtures), "outdated_controller": True})
    joints = []
    for move in moves:
        env.step(move[None])
        joints.append(env.simulations.physics_state(0)[1:8])
    env.close()
    return np.array(joints)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--assets", required=True)
    parser.add_argument("--each", type=int, default=5, help="variants of each suite (default: 5)")
    args = parser.parse_args()
    pictures = []
    for suite in SUITES:
        variants: Any = get_suite(f"{suite}:camera").tasks
        for task in variants[:: len(variants) // args.each][: args.each]:
            pictures.append(compare_pictures(task, args.assets))
            print(f"{task.id:32} {task.variant.view} {pictures[-1]}", flush=True)
    print(
        f"pictures: {len(pictures)} variants; largest difference {max(p[0] for p in pictures)} levels; from the base "
        f"task's, on average {np.mean([p[1] for p in pictures]):.0f}"
    )
    for reading in ("", "_skipped"):
        found = []
        for suite in SUITES:
            variants = get_suite(f"{suite}{reading}:robot").tasks
            for task in variants[:: len(variants) // args.each][: args.each]:
                moves = actions(task.index)
                state, fixtures, theirs = their_arm(task, moves)
                ours = our_arm(task, state, fixtures, moves, str(Path(args.assets)))
                plain = our_arm(task.base, state, fixtures, moves, str(Path(args.assets)))
                gap = np.abs(ours - theirs).max(1)
                found.append(
                    (
                        np.abs(state[1:8] - joint_pose(task.variant.pose)).max(),
                        gap[:SETTLING].max(),
                        gap.max(),
                        np.abs(plain - theirs).max(),
                    )
                )
                print(
                    f"{task.id:32} pose {task.variant.pose:3} {' '.join(f'{x:.1e}' for x in found[-1])}",
                    flush=True,
                )
        start, settling, moving, plain = np.array(found).max(0)
        print(
            f"{reading.strip('_') or 'overwritten'}: {len(found)} variants; largest: start {start:.1e}, "
            f"settling {settling:.1e}, all steps {moving:.1e}; with LIBERO's pose in the controller {plain:.1e}"
        )


if __name__ == "__main__":
    main()
