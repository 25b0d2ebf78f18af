"""A scene in the browser: starts, perturbations, recorded demonstrations frame by frame, a policy that acts.

A `Stage` has what is shown; `Viewer` draws it with mjviser. Simulations and pictures belong to the thread that calls
`Viewer.run`; threads of the browser only change values of controls, which that thread looks at.
"""

import io
import socket
import time
from contextlib import redirect_stdout
from copy import copy

import numpy as np

from libero_env.errors import InvalidInputError, LiberoError, require_known, require_package
from libero_env.geometry import mat_to_quat
from libero_env.mujoco_compat import mujoco
from libero_env.perturbations import KINDS, Perturbation, format_perturbations
from libero_env.perturbations.appearance import mean_colour
from libero_env.tasks.task import NUM_INIT_STATES
from libero_eval.protocols.environment import ProtocolEnv
from libero_integrations.stage import POLICY, Choice, Stage
from libero_integrations.viewer_gate import Gate, gated

_HIDDEN_GROUP = 3  # the first group of geoms and sites that mjviser hides
_REST = 0.3  # [s] that changed controls must rest before a scene is made again
_POLL = 0.02  # [s] between two looks at the controls
_FRUSTUM = 0.06  # [m] size of a camera in the scene
_LINE = 0.002  # [m] thickness of its lines
_DISTANCE = 0.6  # [m] by which the scene is seen from farther away than by the agent's camera
_SEVERITY_STEP = 0.05


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
        require_package("mjviser")
        import viser

        try:
            socket.create_server((host, port)).close()  # viser would take another port without a word
        except OSError as error:
            raise InvalidInputError(
                f"--host {host} --port {port} cannot be listened on: {error.strerror}; --port 0 takes a free port"
            ) from error
        self.stage, self.shown = stage, 0
        gate = Gate(host)
        with gated(gate), redirect_stdout(io.StringIO()):  # its own message is of this machine only
            self.server = viser.ViserServer(host=host, port=port, label="libero view", verbose=False)
        gate.controls = self.server.gui._gui_input_handle_from_uuid.get
        self.port = self.server.get_port()
        self._drawn: ProtocolEnv | None = None
        self._is_stale = self._is_restarted = self._is_stepped = False
        self._outcomes: dict[tuple[str, str], list[bool]] = {}  # of whole episodes of the policy, by task
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
            self.start = gui.add_number("Initial state", first.start, min=0, max=NUM_INIT_STATES - 1, step=1)
            self.play = gui.add_checkbox("Play", False)
            self.step = gui.add_button("Step")
            self.step.on_click(self._on_step)
            self.restart = gui.add_button("Start again")
            self.restart.on_click(self._on_restart)
            self.frame = gui.add_slider("Frame", 0, 1, 1, 0)
            self.camera = gui.add_dropdown("Picture", ["none"])
            self.picture = gui.add_image(np.zeros((1, 1, 3), np.uint8), format="jpeg", visible=False)
            self.cameras = gui.add_checkbox("Cameras in the scene", False)
            self.cameras.on_update(self._on_change)
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
        elif (self.play.value or self._is_stepped) and self.stage.frames:
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
                frustum.visible = self.cameras.value
            self.frame.max = max(1, len(stage.frames) - 1)
            self.frame.value = index
            done = self._outcomes.get(self._kind(), [])
            counted = (
                f"\n\n{sum(done)} of {len(done)} episodes of the policy reached the goal" if done else ""
            )
            self.text.content = stage.describe(index) + counted
            self.picture.visible = self.camera.value != "none"
            if self.picture.visible:
                self.picture.image = self._pictures()

    def close(self) -> None:
        """Free the port and the simulation."""
        self.server.stop()
        self.stage.close()

    def _on_restart(self, event: object) -> None:
        self._is_restarted = True

    def _on_step(self, event: object) -> None:
        self._is_stepped = True

    def _kind(self) -> tuple[str, str]:
        choice = self.stage.choice or self.stage.initial
        return choice.task.id, format_perturbations(choice.perturbations)

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
        self._is_stepped = False
        last = len(self.stage.frames) - 1
        self.show(0 if self.shown >= last else self.shown + 1)
        if self.shown == last:
            self.play.value = False
        self._pace()

    def _act(self) -> None:
        """Let the policy act while `Play` is on, or one `Step`; before that, or when it is over, from the start."""

        def look() -> None:
            self.show(len(self.stage.frames) - 1)
            self._pace()
            while True:
                if self._is_restarted or self.choice() != self.stage.choice:
                    raise _Restarted
                if self.play.value or self._is_stepped:
                    self._is_stepped = False
                    return
                self._scrub()

        try:
            self.stage.act(look)
            self._outcomes.setdefault(self._kind(), []).append(self.stage.is_reached[-1])
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
