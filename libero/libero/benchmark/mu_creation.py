"""The twenty scenes of LIBERO-100 as templates for tasks of one's own; what they say is that of `libero_env.tasks`."""

from typing import Any

from libero.libero.utils.mu_utils import MU_DICT, InitialSceneTemplates, register_mu, scene_key
from libero_env.tasks.builder import build_problem, load_scene
from libero_env.tasks.problem import Problem


class BenchmarkScene(InitialSceneTemplates):
    """A scene of the benchmark; the name of the class says which."""

    def __init__(self) -> None:
        scene = scene_key(type(self).__name__)
        self.problem: Problem = build_problem(load_scene(scene), {"name": scene, "goal": []})
        workspace, *_ = (name for name, category in self.problem.fixtures.items() if name == category)
        super().__init__(workspace, _count(self.problem.fixtures), _count(self.problem.objects))

    def define_regions(self) -> None:
        """The rectangles of the scene; of its middle and half size each."""
        for region in self.problem.regions:
            if region.ranges:
                ((x0, y0, x1, y1),) = region.ranges
                yaw = region.yaw[0] if region.yaw else (0.0, 0.0)
                self.regions |= self.get_region_dict(
                    ((x0 + x1) / 2, (y0 + y1) / 2),
                    region.name,
                    region.target,
                    ((x1 - x0) / 2, (y1 - y0) / 2),
                    yaw,
                )

    @property
    def init_states(self) -> list[tuple[str, ...]]:
        """What holds at the start."""
        return [(atom.predicate, *atom.args) for atom in self.problem.init]


def _count(names: Any) -> dict[str, int]:
    """Category -> number."""
    return {category: list(names.values()).count(category) for category in names.values()}


def _templates(scene_type: str, number: int) -> list[type[BenchmarkScene]]:
    """`KitchenScene1` and so on; registered unless there is another of the name."""
    stem = scene_type.title().replace("_", "")
    classes = [
        type(
            f"{stem}Scene{i}",
            (BenchmarkScene,),
            {"__module__": __name__, "__doc__": f"`{scene_type}_scene{i}`"},
        )
        for i in range(1, number + 1)
    ]
    return [cls if scene_key(cls.__name__) in MU_DICT else register_mu(scene_type)(cls) for cls in classes]


(
    KitchenScene1,
    KitchenScene2,
    KitchenScene3,
    KitchenScene4,
    KitchenScene5,
    KitchenScene6,
    KitchenScene7,
    KitchenScene8,
    KitchenScene9,
    KitchenScene10,
) = _templates("kitchen", 10)
(
    LivingRoomScene1,
    LivingRoomScene2,
    LivingRoomScene3,
    LivingRoomScene4,
    LivingRoomScene5,
    LivingRoomScene6,
) = _templates("living_room", 6)
StudyScene1, StudyScene2, StudyScene3, StudyScene4 = _templates("study", 4)
