"""One configuration for all environments: as keyword arguments, as an object, or both."""

import dataclasses
import inspect

import pytest

from libero_env.envs import BatchEnv, EnvConfig, LiberoEnv
from libero_env.errors import InvalidInputError, LiberoError
from libero_env.perturbations.corruptions import Corruption
from libero_env.perturbations.filters import ActionDelay, ActionGain, StateBias

TASK = "libero_object/0"


def test_every_field_is_documented():
    fields = [field.name for field in dataclasses.fields(EnvConfig)]
    assert [name for name in fields if f"\n        {name}: " not in EnvConfig.__doc__] == []


@pytest.mark.parametrize("environment", [LiberoEnv, BatchEnv])
def test_the_signature_shows_the_options_with_their_default_values(environment):
    parameters = inspect.signature(environment).parameters
    for field in dataclasses.fields(EnvConfig):
        assert parameters[field.name].default == field.default
        assert parameters[field.name].kind is inspect.Parameter.KEYWORD_ONLY


BIRD, DEPTH = {"cameras": ("birdview",)}, {"observations": ("depth", "segmentation_class", "ee_pos")}
REFUSED = [  # perturbations, other options, what is said, options with which they are accepted
    (["delay=1", "noise=1,gain=0.5", "action_noise=1@step3", [ActionDelay(2)], [ActionGain(0.5)]],
     {"control_delta": False}, "moves? the arm; with control_delta=False they are goals", []),
    (["camera=1", "fov=0.5@step3"], BIRD, "changes the camera agentview, which is not among cameras=birdview; add",
     [{"cameras": ()}, {"cameras": ("birdview", "agentview")}]),
    (["light=1", "camera=1,noise=1@step3", [Corruption("fog", 3)]], DEPTH,
     "changes colours only, and observations=depth, .* add rgb, or",
     [{"cameras": (), **DEPTH}, {"observations": ("rgb", "depth")}, {"observations": ("ee_pos",)}]),
    (["proprio_bias=1", "noise=1,proprio_bias=1@step3", [StateBias(0.1)]],
     {"observations": ("rgb", "joint_velocities")}, "not in observations=rgb, joint_velocities; add proprioception",
     [{"observations": ()}, {"observations": ("rgb", "proprioception")}, {"observations": ("rgb", "ee_quat")}]),
]  # fmt: skip


@pytest.mark.parametrize(
    ("perturb", "options", "message", "accepted"), [(p, *row[1:]) for row in REFUSED for p in row[0]]
)
def test_what_would_change_nothing_that_is_seen_or_done_is_refused(perturb, options, message, accepted):
    with pytest.raises(InvalidInputError, match=message):
        EnvConfig(perturb=perturb, **options)
    for others in accepted:
        assert EnvConfig(perturb=perturb, **others)


def test_perturbations_of_pictures_without_colours_are_accepted():
    assert EnvConfig(perturb="camera=1,latency=1,dropped_frames=1", **DEPTH)


def test_an_event_at_a_step_that_no_episode_has_is_refused(closing):
    with pytest.raises(InvalidInputError, match="event @step5: an episode has the steps 0 to 4"):
        LiberoEnv(TASK, cameras=(), horizon=5, perturb="noise=1@step5")
    closing(LiberoEnv(TASK, cameras=(), horizon=6, perturb="noise=1@step5"))


@pytest.mark.sim
def test_options_replace_fields_of_the_configuration(closing):
    config = EnvConfig(cameras=("agentview",), camera_size=(16, 16), horizon=3, reward="staged")
    env = closing(LiberoEnv(TASK, config=config, horizon=2))
    assert env.config == dataclasses.replace(config, horizon=2)
    seen, _ = env.reset(options={"init_state": 0})
    assert seen["agentview_rgb"].shape == (16, 16, 3) and "eye_in_hand_rgb" not in seen
    assert [env.step([0.0] * 7)[2:4] for _ in range(2)] == [(False, False), (False, True)]
    with pytest.raises(LiberoError, match="reset"):
        env.step([0.0] * 7)
    assert LiberoEnv(TASK, camera_size=16, cameras=("agentview",)).config.camera_size == (16, 16)
