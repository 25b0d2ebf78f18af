"""TorchRL's own `LiberoEnv`, unchanged: its specs, groups that start alike, and the group of GRPO that the page shows.

`make test` installs TorchRL.
"""

import re
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("torchrl")

from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torchrl.envs import LiberoEnv
from torchrl.envs.utils import check_env_specs
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import ClipPPOLoss

from lifelong.reward.grpo import clipped_loss

pytestmark = [pytest.mark.sim, pytest.mark.filterwarnings("ignore::DeprecationWarning")]
PAGE = Path(__file__).parents[2] / "docs" / "migrating.md"


@pytest.fixture(autouse=True)
def own_configuration(tmp_path, monkeypatch):
    """A folder for the configuration file, which TorchRL writes."""
    monkeypatch.setenv("LIBERO_CONFIG_PATH", str(tmp_path))


@pytest.mark.parametrize("suite", ["libero_object", "libero_goal"])  # without and with fixtures
def test_specs_hold_and_groups_start_alike(suite):
    size = {"camera_height": 32, "camera_width": 32, "wrist_camera": "robot0_eye_in_hand"}
    env = LiberoEnv(suite, 0, **size, group_repeats=3, max_episode_steps=3, settle_steps=2)
    check_env_specs(env, seed=0)
    assert env._env.env.drawing == "fast"
    starts = defaultdict(list)
    for _ in range(8):
        seen = env.reset()
        state = env._env.env.simulations.get_state(0)  # fixtures, controller and warm start, too
        starts[int(seen["group_id"])].append((state, seen["observation", "image"].numpy()))
        env.step(env.rand_action(seen))
    env.close()
    whole = [group for group in starts.values() if len(group) == 3]
    assert len(whole) >= 2
    for group in whole:
        for state, image in group:
            np.testing.assert_array_equal(state, group[0][0])
            np.testing.assert_array_equal(image, group[0][1])
    assert not np.array_equal(whole[0][0][0], whole[1][0][0])


def test_the_group_of_the_page_has_advantages_and_gradients():
    (code,) = re.findall(r"^```python\n(import torch\n.*?)^```", PAGE.read_text(), re.M | re.S)
    names = {}
    exec(compile(code, str(PAGE), "exec"), names)  # noqa: S102
    names["env"].close()
    episodes, steps = names["episodes"], names["steps"]
    group = names["group"][:].reshape(episodes, steps)
    assert group["group_id"].unique().numel() == 1
    first = group["observation", "state"][:, 0]
    assert torch.equal(first, first[:1].expand(episodes, -1))
    returns = group["next", "reward"].sum(1)
    expected = (returns - returns.mean()) / returns.std()
    assert returns.std() > 0
    expected = expected[:, None].expand(-1, steps, -1)
    torch.testing.assert_close(group["advantage"], expected, rtol=1e-3, atol=1e-3)
    assert any(p.grad is not None and p.grad.any() for p in names["network"].parameters())


def test_the_objective_of_learning_from_reward_is_theirs():
    torch.manual_seed(0)
    network = torch.nn.Sequential(torch.nn.Linear(5, 14), NormalParamExtractor())
    module = TensorDictModule(network, ["seen"], ["loc", "scale"])
    policy = ProbabilisticActor(
        module, ["loc", "scale"], distribution_class=TanhNormal, return_log_prob=True, log_prob_key="drawn"
    )
    with torch.no_grad():
        batch = policy(TensorDict({"seen": torch.randn(200, 5)}, [200]))
        batch["advantage"] = torch.randn(200, 1)
        network[0].weight += 0.05 * torch.randn_like(network[0].weight)
    loss = ClipPPOLoss(policy, critic_network=None, entropy_bonus=False, clip_epsilon=0.2)
    loss.set_keys(sample_log_prob="drawn")
    theirs = loss(batch.clone())["loss_objective"]
    now = policy.get_dist(batch).log_prob(batch["action"])
    ours = clipped_loss(now, batch["drawn"], batch["advantage"][:, 0], 0.2, 0.2)
    assert ((now - batch["drawn"]).abs() > np.log(1.2)).float().mean() > 0.1, "some are clipped"
    torch.testing.assert_close(ours, theirs)
    weights = list(network.parameters())
    for mine, other in zip(
        torch.autograd.grad(ours, weights), torch.autograd.grad(theirs, weights), strict=True
    ):
        torch.testing.assert_close(mine, other)
