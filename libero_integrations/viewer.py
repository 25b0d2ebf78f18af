"""A scene in the browser: starts, perturbations, recorded demonstrations frame by frame, a policy that acts.

`Stage` has what is shown, without a browser; `Viewer` draws it with mjviser. Simulations and pictures belong to the
thread that calls `Viewer.run`; threads of the browser only change values of controls, which that thread looks at.
"""

import io
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from libero_env.demos.config import RenderConfig
from libero_env.demos.observe import fixture_poses, recorded_frequency, recorded_robot, recorded_task
from libero_env.demos.read import Episode, read_episodes
from libero_env.errors import InvalidInputError, LiberoError, require_known, require_package
from libero_env.geometry import mat_to_quat
from libero_env.mujoco_compat import mujoco
from libero_env.perturbations import KINDS, Perturbation, format_perturbations, parse_perturbations
from libero_env.perturbations.appearance import mean_colour
from libero_env.sim.observations import image_name
from libero_env.tasks import Task, find_tasks, read_task
from libero_eval.plan import load_policy, resolve_protocol
from libero_eval.protocols.environment import ProtocolEnv
from libero_eval.protocols.files import load_protocol
from libero_eval.protocols.protocol import EvalProtocol
from libero_eval.requests import EvalRequest, ViewRequest
from lifelong.evaluation.actors import Actor, WatchesWorld
from lifelong.evaluation.environments import Obs
from lifelong.evaluation.rollout import run_episodes

POLICY = "policy"  # what is shown where it is not a recorded demonstration
_TASK_FILES = (".bddl", ".yaml", ".yml")
_HIDDEN_GROUP = 3  # the first group of geoms and sites that mjviser hides
_REST = 0.3  # [s] that changed controls must rest before a scene is made again
_POLL = 0.02  # [s] between two looks at the controls
_FRUSTUM = 0.06  # [m] size of a camera in the scene
_LINE = 0.002  # [m] thickness of its lines
_DISTANCE = 0.6  # [m] by which the scene is seen from farther away than by the agent's camera
_SEVERITY_STEP = 0.05


@dataclass(frozen=True)
class Choice:
    """What is to be shown.

    Attributes:
        source: `POLICY`, or the name of a recorded demonstration.
        start: Initial state in which the policy starts.
        perturbations: Perturbations of a severity above 0.
    """

    task: Task
    source: str = POLICY
    start: int = 0
    perturbations: tuple[Perturbation, ...] = ()


class Stage:
    """A simulation that is put into the frames of an episode: of a recorded one, or of one in which a policy acts.

    Args:
        request: What is asked for.

    Attributes:
        tasks: Tasks to choose from.
        sources: What can be shown of them: `POLICY`, and the names of recorded demonstrations.
        initial: What is shown first.
        choice: What is shown.
        env: The simulation.
        frames: States of the episode: those of `BatchEnv.get_state`, or [time, qpos, qvel] of a recording.
        truths: Whether each atom of the goal holds in each frame.
        is_reached: Whether the goal holds in each frame.

    Raises:
        LiberoError: The task, the policy or the file does not exist, or is not valid.
    """

    def __init__(self, request: ViewRequest):
        self.request, what = request, request.what
        self._file = Path(what) if what.endswith(".hdf5") else None
        is_run = self._file is None and not what.endswith(_TASK_FILES) and Path(what).exists()
        if request.bddl is not None and self._file is None:
            raise InvalidInputError(f"--bddl is of demonstration files, and {what} is not one")
        if is_run and request.policy is not None:
            raise InvalidInputError(
                f"{what} is a run, whose policy acts: leave out --policy {request.policy}"
            )
        evaluation = EvalRequest(
            policy=what if is_run else request.policy or "expert",
            protocol=request.protocol,
            seed=request.seed,
            assets=request.assets,
            robot=None if self._file is None else recorded_robot(self._file),
            control_freq=None if self._file is None else recorded_frequency(self._file),
            device=request.device,
            allow=request.allow,
        )
        self.sources: tuple[str, ...] = (POLICY,)
        self.tasks: Sequence[Task] = ()
        if self._file is not None:
            self.tasks = [recorded_task(self._file) if request.bddl is None else read_task(request.bddl)]
            self.sources = (*(one.name for one in read_episodes(self._file, observations=False)), POLICY)
        elif not is_run:
            self.tasks = find_tasks([what])
        self.policy = load_policy(evaluation)
        self.tasks = self.tasks or self.policy.tasks
        base = self.policy.protocol(load_protocol(request.protocol))
        self._protocol = resolve_protocol(evaluation, base, self.tasks)
        perturb = request.perturb or self._protocol.world.perturb
        perturbations = parse_perturbations(perturb, request.perturb_seed)
        self.initial = Choice(
            self.tasks[0], self.sources[0], request.start, tuple(one for one in perturbations if one.severity)
        )
        self.choice: Choice | None = None
        self.env: ProtocolEnv | None = None
        self.frames: list[np.ndarray] = []
        self.truths: list[dict[str, bool]] = []
        self.is_reached: list[bool] = []

    @property
    def protocol(self) -> EvalProtocol:
        """Protocol of the episodes, with the perturbations that are chosen."""
        chosen = () if self.choice is None else self.choice.perturbations
        return self._protocol.changed({"world.perturb": format_perturbations(chosen)})

    def open(self, choice: Choice) -> None:
        """Take the episode that is chosen, or the first frame of the one that the policy would act in.

        Raises:
            LiberoError: The perturbations do not fit the task or the recording, or there is no such start.
        """
        before, self.choice = self.choice, choice
        self._clear()
        if choice.source != POLICY:
            RenderConfig(perturb=choice.perturbations)  # refuses those that recorded states do not have
        if before is None or (before.task, before.perturbations) != (choice.task, choice.perturbations):
            self.close()
        if self.env is None:
            self.env = ProtocolEnv(
                self.protocol, choice.task, 1, cameras=(), threads=1, assets=self.request.assets
            )
        if choice.source == POLICY:
            self.env.reset(options={"init_state": choice.start})
            self._add(self.env.get_state(0))
            return
        episode = self._recording(choice.source)
        self.env.simulations.fixtures[0] = fixture_poses(
            episode, self.env.scene, f"{self._file}: {episode.name}"
        )
        if self.env.perturbed is not None:
            self.env.perturbed.open(0, episode.name)
            self.env.observer.set_appearance(0, self.env.perturbed.appearance(0))
        for state in episode.states:
            self._add(state)

    def act(self, before_step: Callable[[], None]) -> None:
        """Let the policy act in a new episode, whose frames take the place of those that are shown.

        Args:
            before_step: Function that is called in each frame before the policy acts; it may raise to end the episode.

        Raises:
            LiberoError: The policy cannot act in this task, or the simulation fails.
        """
        choice, protocol = self.choice, self.protocol
        assert choice is not None
        self._clear()
        env = self.policy.env(choice.task, 1, protocol)

        def look() -> None:
            self._add(env.get_state(0))
            before_step()

        try:
            with self.policy.actor(env.task, [choice.start], protocol) as actor:
                if isinstance(actor, WatchesWorld):
                    actor.watch(env)
                run_episodes(
                    _WatchedActor(actor, look),
                    env,
                    [choice.start],
                    horizon=protocol.steps(choice.task),
                    settle_steps=protocol.settle_steps,
                    settle_action=protocol.episode.settle_action,
                )
            self._add(env.get_state(0))
        finally:
            env.close()

    def show(self, index: int) -> None:
        """Put the simulation into a frame; forces are those of the motors' commands where the frame has them."""
        assert self.env is not None
        self.env.set_state(0, self.frames[index])
        if self.env.perturbed is not None:
            self.env.perturbed.steps[0] = index
        simulations = self.env.simulations
        mujoco.mj_forward(simulations.model, simulations.data(0))

    def picture(self, camera: str) -> np.ndarray:
        """Return what arrives of a camera's picture in the frame that is shown, (H, W, 3) uint8.

        Pictures that perturbations delay or drop are not: each is that of its frame.
        """
        assert self.env is not None
        rows = self.env.observer.render(0, camera)[None]
        if self.env.perturbed is not None:
            self.env.perturbed.see_images([0], {image_name(camera, "rgb"): rows})
        return rows[0]

    def describe(self, index: int) -> str:
        """Return the instruction and the atoms of the goal in a frame, and since when they hold, as Markdown."""
        assert self.env is not None
        lines = [
            f"**{self.env.task.language}**",
            f"{index / self.env.config.control_freq:.2f} s, frame {index}:",
        ]
        for atom, holds in self.truths[index].items():
            since = index
            while since and self.truths[since - 1][atom] == holds:
                since -= 1
            word = f"● `{atom}` true" if holds else f"○ `{atom}` false"
            lines.append(f"{word}, since frame {since}" if since else word)
        lines.append("the goal is reached" if self.is_reached[index] else "the goal is not reached")
        return "\n\n".join(lines)

    def close(self) -> None:
        """Free the simulation."""
        if self.env is not None:
            self.env.close()
        self.env = None

    def _clear(self) -> None:
        self.frames, self.truths, self.is_reached = [], [], []

    def _add(self, state: np.ndarray) -> None:
        assert self.env is not None and self.choice is not None
        if self.frames and self.choice.source != POLICY:  # conditions over time remember the frames before
            self.env.simulations.set_physics_state(0, state)
        else:
            self.env.set_state(0, state)
        reached, truth = self.env.check_goal(0)
        self.frames.append(state)
        self.truths.append(truth)
        self.is_reached.append(reached)

    def _recording(self, name: str) -> Episode:
        assert self._file is not None
        return next(one for one in read_episodes(self._file, observations=False) if one.name == name)


class _WatchedActor:
    """An actor before whose every step a function is called."""

    action_dim: int
    views: tuple[str, ...]
    reset: Callable[[int], None]

    def __init__(self, actor: Actor, look: Callable[[], None]):
        self._actor, self._look = actor, look

    def __getattr__(self, name: str) -> Any:
        return getattr(self._actor, name)

    def act(self, obs: Obs) -> np.ndarray:
        self._look()
        return self._actor.act(obs)


class _Restarted(Exception):
    """Something else is to be shown than the episode in which the policy acts."""


class Viewer:
    """A stage in the browser.

    Clients that leave and come back find everything as it is, and share it with others.

    Args:
        stage: What is shown.
        host: Address to listen on.
        port: Port to listen on; 0 for a free one.

    Attributes:
        port: Port that is listened on.
        shown: Index of the frame that is shown.

    Raises:
        MissingPackageError: mjviser is not installed.
        InvalidInputError: The address cannot be listened on.
    """

    def __init__(self, stage: Stage, host: str, port: int):
        require_package("mjviser", "view")
        import viser

        try:
            socket.create_server((host, port)).close()  # viser would take another port without a word
        except OSError as error:
            raise InvalidInputError(
                f"--host {host} --port {port} cannot be listened on: {error.strerror}; --port 0 takes a free port"
            ) from error
        self.stage, self.shown = stage, 0
        with redirect_stdout(io.StringIO()):  # its own message is of this machine only
            self.server = viser.ViserServer(host=host, port=port, label="libero view", verbose=False)
        self.port = self.server.get_port()
        self._drawn: ProtocolEnv | None = None
        self._is_stale = self._is_restarted = False
        self._wanted, self._since, self._next = stage.initial, 0.0, 0.0
        self._add_controls()

    def _add_controls(self) -> None:
        gui, first = self.server.gui, self.stage.initial
        self._tasks = {f"{task.id} {task.language}": task for task in self.stage.tasks}
        self.text = gui.add_markdown("")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Episode"):
            self.task = gui.add_dropdown("Task", list(self._tasks))
            self.source = gui.add_dropdown("Shows", self.stage.sources)
            self.start = gui.add_number("Initial state", first.start, min=0, step=1)
            self.play = gui.add_checkbox("Play", False)
            self.restart = gui.add_button("Start again")
            self.restart.on_click(self._on_restart)
            self.frame = gui.add_slider("Frame", 0, 1, 1, 0)
            self.camera = gui.add_dropdown("Picture", ["none"])
            self.picture = gui.add_image(np.zeros((1, 1, 3), np.uint8), format="jpeg", visible=False)
        with tabs.add_tab("Perturbations"):
            given = {one.kind: one.severity for one in first.perturbations}
            self.severities = {
                name: gui.add_slider(name, 0.0, 1.0, _SEVERITY_STEP, given.get(name, 0.0), hint=kind.what)
                for name, kind in KINDS.items()
            }
        self._scene_tabs = [tabs.add_tab("Forces"), tabs.add_tab("Groups")]
        self._scene_folders: list = []

    def run(self) -> None:
        """Show what the controls say until interrupted."""
        while True:
            self.update()

    def update(self) -> None:
        """Look at the controls once, and do what they say; clients may have set values that are not offered."""
        try:
            self._update()
        except LiberoError as error:
            self._tell(error)
            self._is_stale = True
            time.sleep(_REST)

    def _update(self) -> None:
        choice = self.choice()
        if self._is_restarted:
            self.open(choice)
        elif choice != self.stage.choice:
            self._open_at_rest(choice)
        elif self.play.value and self.stage.frames:
            self._play()
        else:
            self._scrub()

    def choice(self) -> Choice:
        """Return what the controls ask for.

        Raises:
            LiberoError: Nothing of the kind is offered.
        """
        require_known("task", self.task.value, self._tasks)
        require_known("recording", self.source.value, self.stage.sources)
        seeds = {one.kind: one.seed for one in self.stage.initial.perturbations}
        perturbations = [
            Perturbation(kind, slider.value, seeds.get(kind, self.stage.request.perturb_seed))
            for kind, slider in self.severities.items()
            if slider.value
        ]
        return Choice(
            self._tasks[self.task.value], self.source.value, int(self.start.value), tuple(perturbations)
        )

    def open(self, choice: Choice) -> None:
        """Show the first frame of what is chosen, or why it cannot be shown."""
        self._is_restarted = False
        self.play.value = False
        self.text.content = "making the scene ..."
        try:
            self.stage.open(choice)
            if self.stage.env is not self._drawn:
                self._draw_scene()
            self.show(0)
        except LiberoError as error:
            self._tell(error)

    def show(self, index: int) -> None:
        """Show a frame."""
        stage, env = self.stage, self.stage.env
        assert env is not None
        self.shown, self._is_stale = index, False
        stage.show(index)
        with self.server.atomic():
            self.scene.update_from_mjdata(env.simulations.data(0))
            for name, frustum in self._frustums.items():
                pose = env.observer.camera_to_world(0, name)
                frustum.position, frustum.wxyz = pose[:3, 3], mat_to_quat(pose[:3, :3])
            self.frame.max = max(1, len(stage.frames) - 1)
            self.frame.value = index
            self.text.content = stage.describe(index)
            self.picture.visible = self.camera.value != "none"
            if self.picture.visible:
                self.picture.image = self._pictures()

    def close(self) -> None:
        """Free the port and the simulation."""
        self.server.stop()
        self.stage.close()

    def _on_restart(self, event: object) -> None:
        self._is_restarted = True

    def _on_change(self, *event: object) -> None:
        self._is_stale = True

    def _tell(self, error: LiberoError) -> None:
        self.play.value = False
        self.text.content = f"**not possible:** {error}"

    def _open_at_rest(self, choice: Choice) -> None:
        """Show what is chosen as soon as it has not changed for a while."""
        now = time.monotonic()
        if choice != self._wanted:
            self._wanted, self._since = choice, now
        elif now - self._since >= _REST:
            self.open(choice)
            return
        time.sleep(_POLL)

    def _scrub(self) -> None:
        """Show the frame that is chosen."""
        index = min(int(self.frame.value), len(self.stage.frames) - 1)
        if index >= 0 and (index != self.shown or self._is_stale):
            self.show(index)
        else:
            time.sleep(_POLL)

    def _play(self) -> None:
        if self.stage.choice is not None and self.stage.choice.source == POLICY:
            self._act()
            return
        last = len(self.stage.frames) - 1
        self.show(0 if self.shown >= last else self.shown + 1)
        if self.shown == last:
            self.play.value = False
        self._pace()

    def _act(self) -> None:
        """Let the policy act, step by step while `Play` is on; before that, or when it is over, from the start."""

        def look() -> None:
            self.show(len(self.stage.frames) - 1)
            self._pace()
            while True:
                if self._is_restarted or self.choice() != self.stage.choice:
                    raise _Restarted
                if self.play.value:
                    return
                self._scrub()

        try:
            self.stage.act(look)
            self.show(len(self.stage.frames) - 1)
            self.play.value = False
        except _Restarted:
            return
        except LiberoError as error:
            self._tell(error)

    def _pace(self) -> None:
        """Wait until a control step has passed since the last frame."""
        self._next = max(self._next + 1.0 / self.stage.protocol.world.control_freq, time.monotonic())
        time.sleep(self._next - time.monotonic() if self._next > time.monotonic() else 0.0)

    def _draw_scene(self) -> None:
        """Draw another scene, and make the controls that are of it."""
        from mjviser import ViserMujocoScene

        env, gui = self.stage.env, self.server.gui
        assert env is not None
        self.server.scene.reset()
        self.scene = ViserMujocoScene(self.server, display_model(env), num_envs=1)
        self.scene.camera_tracking_enabled = False
        self.scene.set_refresh_handler(self._on_change)
        for folder in self._scene_folders:
            folder.remove()
        self._scene_folders = []
        for tab, add in zip(
            self._scene_tabs, (self.scene.create_overlay_gui, self.scene.create_groups_gui), strict=True
        ):
            with tab:
                self._scene_folders.append(gui.add_folder(None))
            with self._scene_folders[-1]:
                add()
        names = [env.scene.model.cam(i).name for i in range(env.scene.model.ncam)]
        self._frustums = {}
        for name in names:
            height, width = env.observer.camera_size
            view = 2 * np.arctan(0.5 * height / env.observer.intrinsics(name)[1, 1])
            self._frustums[name] = self.server.scene.add_camera_frustum(
                f"/cameras/{name}", view, width / height, scale=_FRUSTUM, thickness=_LINE, color=(40, 90, 200)
            )
        chosen = self.camera.value
        self.camera.options = ["all", *names, "none"]
        self.camera.value = chosen if chosen in names else "all"
        self.camera.on_update(self._on_change)
        pose = env.observer.camera_to_world(0, "agentview")
        camera = self.server.initial_camera
        camera.look_at = pose[:3, 3] + pose[:3, 2]
        camera.position = pose[:3, 3] - _DISTANCE * pose[:3, 2]
        self._drawn = env

    def _pictures(self) -> np.ndarray:
        """Return the chosen picture, or those of all cameras in two columns."""
        require_known("picture", self.camera.value, self.camera.options)
        if self.camera.value != "all":
            return self.stage.picture(self.camera.value)
        pictures = [self.stage.picture(name) for name in self._frustums]
        pictures += [np.zeros_like(pictures[0])] * (len(pictures) % 2)
        rows = [np.concatenate(pictures[i : i + 2], axis=1) for i in range(0, len(pictures), 2)]
        return np.concatenate(rows)


def display_model(env: ProtocolEnv) -> mujoco.MjModel:
    """Return a copy of an environment's model for mjviser.

    Collision shapes and sites are hidden at first. Fixtures, which stand elsewhere in each start, count as moving.
    Shapes other than meshes, whose textures mjviser does not draw, have the mean colour of their texture.
    """
    env.simulations.pose_fixtures(0)
    model = copy(env.simulations.model)
    model.geom_group[model.geom_group == 0] = _HIDDEN_GROUP
    model.site_group[:] = _HIDDEN_GROUP
    for geom in np.flatnonzero((model.geom_type != mujoco.mjtGeom.mjGEOM_MESH) & (model.geom_matid >= 0)):
        material = model.geom_matid[geom]
        if model.mat_texid[material].max() >= 0:
            model.geom_rgba[geom] = model.mat_rgba[material]
            model.geom_rgba[geom, :3] = mean_colour(model, material)
            model.geom_matid[geom] = -1
    fixtures = np.isin(model.body_rootid, env.scene.fixture_bodies) & (model.body_weldid == 0)
    model.body_weldid[fixtures] = np.flatnonzero(fixtures)
    return model
