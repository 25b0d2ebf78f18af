"""One configuration for all environments: as keyword arguments, as an object, or both."""

import dataclasses
import inspect

import pytest

from libero_env.envs import BatchEnv, EnvConfig, LiberoEnv
from libero_env.errors import InvalidInputError, LiberoError
from libero_env.perturbations.corruptions import Corruption
from libero_env.perturbations.filters import ActionDelay, ActionGain, StateBias

TASK = "libero_object/0"
FIELDS = [field.name for field in dataclasses.fields(EnvConfig)]
ENVIRONMENTS = [LiberoEnv, BatchEnv]


def test_every_field_is_documented():
    for name in FIELDS:
        assert f"\n        {name}: " in EnvConfig.__doc__


@pytest.mark.parametrize("environment", ENVIRONMENTS, ids=lambda cls: cls.__name__)
def test_the_signature_shows_the_options_with_their_default_values(environment):
    parameters = inspect.signature(environment).parameters
    for field in dataclasses.fields(EnvConfig):
        assert parameters[field.name].default == field.default
        assert parameters[field.name].kind is inspect.Parameter.KEYWORD_ONLY


@pytest.mark.parametrize(
    "perturb", ["delay=1", "noise=1,gain=0.5", "action_noise=1@step3", [ActionDelay(2)], [ActionGain(0.5)]]
)
def test_perturbed_actions_are_relative(perturb):
    with pytest.raises(InvalidInputError, match="moves? the arm; with control_delta=False they are goals"):
        EnvConfig(perturb=perturb, control_delta=False)


@pytest.mark.parametrize("perturb", ["camera=1", "fov=0.5@step3"])
def test_a_camera_that_is_perturbed_is_seen(perturb):
    with pytest.raises(
        InvalidInputError, match="changes the camera agentview, which is not among cameras=birdview; add"
    ):
        EnvConfig(perturb=perturb, cameras=("birdview",))
    for cameras in ((), ("birdview", "agentview")):
        assert EnvConfig(perturb=perturb, cameras=cameras)


@pytest.mark.parametrize("perturb", ["light=1", "camera=1,noise=1@step3", [Corruption("fog", 3)]])
def test_what_changes_colours_only_is_refused_where_pictures_have_none(perturb):
    seen = {"observations": ("depth", "segmentation_class", "ee_pos")}
    with pytest.raises(
        InvalidInputError, match="changes colours only, and observations=depth, .* add rgb, or"
    ):
        EnvConfig(perturb=perturb, **seen)
    for options in (
        {"cameras": (), **seen},
        {"observations": ("rgb", "depth")},
        {"observations": ("ee_pos",)},
    ):
        assert EnvConfig(perturb=perturb, **options)
    assert EnvConfig(perturb="camera=1,latency=1,dropped_frames=1", **seen)


@pytest.mark.parametrize("perturb", ["proprio_bias=1", "noise=1,proprio_bias=1@step3", [StateBias(0.1)]])
def test_sensors_that_are_off_are_observed(perturb):
    with pytest.raises(
        InvalidInputError, match="not in observations=rgb, joint_velocities; add proprioception"
    ):
        EnvConfig(perturb=perturb, observations=("rgb", "joint_velocities"))
    for names in ((), ("rgb", "proprioception"), ("rgb", "ee_quat")):
        assert EnvConfig(perturb=perturb, observations=names)


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
