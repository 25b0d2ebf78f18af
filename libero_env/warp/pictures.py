"""Pictures of all simulations at once, by MuJoCo Warp's ray-tracer.

They are not those of OpenGL: rays meet the meshes themselves, textures are filtered otherwise, nothing is mirrored, and
no site glows. They show the same cameras, sizes, geoms and lights.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import mujoco_warp as mjw
import numpy as np
import warp as wp

from libero_env.errors import InvalidInputError, LiberoError
from libero_env.sim.appearance import Appearance
from libero_env.sim.observations import Observer, image_name
from libero_env.sim.simulation import Indices
from libero_env.warp.device import room_for
from libero_env.warp.simulations import WarpSimulations

wp.set_module_options({"enable_backward": False})

_VISUAL_GROUP = 1  # as `libero_env.sim.render.Renderer` draws


@wp.kernel
def pack_colours(colours: wp.array3d[wp.vec3], out: wp.array4d[wp.uint8]):
    """Write colours in [0, 1] as bytes."""
    i, row, column = wp.tid()
    colour = colours[i, row, column]
    for c in range(3):
        out[i, row, column, c] = wp.uint8(wp.clamp(colour[c], 0.0, 1.0) * 255.0 + 0.5)


class WarpObserver(Observer):
    """Observer of simulations of MuJoCo Warp, whose pictures are ray-traced on their device.

    Raises:
        LiberoError: An image is asked for that the ray-tracer does not draw.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        if self.segmentation:
            raise LiberoError("backend=warp draws rgb and depth; segmentation needs backend=mujoco")

    def set_appearance(self, i: int, appearance: Appearance) -> None:
        """Raise unless the appearance is that of the model.

        Raises:
            LiberoError: It is another: cameras, lights and materials are those of the model here.
        """
        if appearance != Appearance():
            raise LiberoError(
                "backend=warp draws every simulation as its model says; perturbations of cameras, lights and "
                "materials need backend=mujoco"
            )

    def render_cameras(self, ids: Indices, images: dict[str, np.ndarray]) -> None:
        """Render the observed images of simulations; the cost is that of all.

        Args:
            images: Arrays of `empty_images`, whose rows `ids` are overwritten.
        """
        if images and len(ids):
            rows = np.asarray(ids, np.int64)
            for name, pictures in self._tracer.trace().items():
                images[name][rows] = pictures[rows]

    def render(self, i: int, camera: str, kind: str = "rgb") -> np.ndarray:
        """Render one image of simulation i, from one of the observed cameras.

        Args:
            i: Index of the simulation.
            kind: `rgb` or `depth`, as is observed.

        Raises:
            InvalidInputError: It is not among the observed images.
        """
        name = image_name(camera, kind)
        if camera not in self._cameras or kind not in self._kinds:
            known = ", ".join(self.empty_images(1)) or "none"
            raise InvalidInputError(
                f"backend=warp draws the images that are observed ({known}), not {name}; name its camera in cameras="
            )
        return self._tracer.trace()[name][i].copy()

    def close(self) -> None:
        """Free the arrays of the ray-tracer."""
        super().close()
        self.__dict__.pop("_tracer", None)

    @cached_property
    def _tracer(self) -> "_RayTracer":
        assert isinstance(self.simulations, WarpSimulations)
        return _RayTracer(self.simulations, self._cameras, self._kinds, self.camera_size)


class _RayTracer:
    """Ray-tracer of some cameras of all simulations.

    Args:
        cameras: Index in the model of each camera, by name.
        kinds: Kinds of images, of `rgb` and `depth`.
        size: Height and width of the images, pixels.
    """

    def __init__(
        self,
        simulations: WarpSimulations,
        cameras: dict[str, int],
        kinds: Sequence[str],
        size: tuple[int, int],
    ):
        self._simulations, self._kinds, model = simulations, kinds, simulations.model
        drawn = sorted(cameras, key=cameras.__getitem__)  # numbered in the order of the model
        self._places = {name: drawn.index(name) for name in cameras}
        (height, width), num = size, simulations.num
        with wp.ScopedDevice(simulations.device), room_for(num, simulations.backend):
            self._context = mjw.create_render_context(
                model,
                nworld=num,
                cam_res=(width, height),
                render_rgb="rgb" in kinds,
                render_depth="depth" in kinds,
                render_seg=False,
                enabled_geom_groups=[_VISUAL_GROUP],
                cam_active=drawn,
            )
            self._colours = wp.zeros((num, height, width), dtype=wp.vec3)
            self._bytes = wp.zeros((num, height, width, 3), dtype=wp.uint8)
            self._depths = wp.zeros((num, height, width), dtype=float)
        self._far = np.float32(model.vis.map.zfar * model.stat.extent)

    def trace(self) -> dict[str, np.ndarray]:
        """Return the images of all simulations: name -> (num, height, width, ...)."""
        simulations, found = self._simulations, dict[str, np.ndarray]()
        with wp.ScopedDevice(simulations.device):
            mjw.refit_bvh(simulations.device_model, simulations.device_data, self._context)
            mjw.render(simulations.device_model, simulations.device_data, self._context)
            for camera, place in self._places.items():
                if "rgb" in self._kinds:
                    mjw.get_rgb(self._context, place, self._colours)
                    wp.launch(
                        pack_colours, self._colours.shape, inputs=[self._colours], outputs=[self._bytes]
                    )
                    found[image_name(camera, "rgb")] = self._bytes.numpy().copy()
                if "depth" in self._kinds:
                    # as a share of the farthest distance, 0 for nothing
                    mjw.get_depth(self._context, place, self._far, self._depths)
                    depths = self._far * self._depths.numpy()
                    found[image_name(camera, "depth")] = np.where(depths > 0.0, depths, self._far)
        return found
