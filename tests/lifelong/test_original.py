"""`preset=paper compat=libero` is LIBERO's code: the same weights and batches give the same losses and gradients.

Where LIBERO's code is at hand both are run side by side. Everywhere, ours is compared with what was recorded of it.
"""

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats

from lifelong.nn.augmentation import SharedShift
from lifelong.seeding import generator
from lifelong.settings import build
from tests.harness import original, original_results
from tests.harness.configs import composed
from tests.harness.original import QUICK
from tests.harness.original_results import relative, update_difference, where_owners_agree, worst

RECORDED = Path(__file__).parent / "data" / "original.npz"
TENSORS = {
    "loss": 1e-5, "eval_loss": 1e-5, "act_means": 1e-5, "act_stds": 1e-5, "act_logits": 1e-5, "rates": 1e-12
}  # fmt: skip


def given() -> dict:
    """The batches of the comparison: two of windows, and an episode longer than a window."""
    first, second = (original.smooth_batch(QUICK, number) for number in range(2))
    return {"first": first, "second": second, "episode": original.smooth_batch(QUICK, 2, steps=6)}


@pytest.fixture(scope="module")
def elsewhere():
    """Call a function in a process whose matrix products round alike on every processor.

    Where a unit is at the kink of a ReLU, rounding decides about its share of the gradient.
    """
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("MKL_CBWR", "COMPATIBLE")
            pool.submit(int).result()  # it is started here
        yield lambda function, *values: pool.submit(function, *values).result()


@pytest.mark.parametrize("name", original.POLICIES)
def test_losses_gradients_and_actions_are_those_recorded_of_the_original(name, elsewhere):
    elsewhere(check_learning, name)


def test_dropout_ewc_and_packnet_are_those_recorded_of_the_original(elsewhere):
    elsewhere(check_dropout_ewc_and_packnet)


def check_learning(name: str) -> None:
    policy, batches = original.our_policy(name, QUICK), given()
    ours = original_results.measure(policy, batches["first"], batches["episode"])
    with np.load(RECORDED) as recorded:
        for key, tolerance in TENSORS.items():
            theirs = torch.from_numpy(recorded[f"{name}/{key}"])
            assert relative(ours[key], theirs) < tolerance, key
        assert_recorded(ours["gradient"], recorded, f"{name}/gradient", 1e-4)


def check_dropout_ewc_and_packnet() -> None:
    name, batches = "bc_transformer", given()
    policy = original.our_policy(name, QUICK, dropout=True)
    dropped = original_results.with_dropout(policy, batches["first"])
    of_ewc = original_results.ewc(original.our_policy(name, QUICK), batches["first"], batches["second"])
    of_packnet = original_results.packnet(
        original.our_policy(name, QUICK), batches["first"], batches["second"]
    )
    with np.load(RECORDED) as recorded:
        assert relative(dropped["dropout_loss"], torch.from_numpy(recorded[f"{name}/dropout_loss"])) < 1e-5
        assert relative(of_ewc["penalty"], torch.from_numpy(recorded[f"{name}/penalty"])) < 1e-4
        assert_recorded(dropped["dropout_gradient"], recorded, f"{name}/dropout_gradient", 1e-4)
        assert_recorded(of_ewc["fisher"], recorded, f"{name}/fisher", 2e-4)
        assert_recorded(of_ewc["ewc_clipped"], recorded, f"{name}/ewc_clipped", 2e-4)
        # weights at the threshold may be decided by rounding
        assert_recorded(of_packnet["owner"], recorded, f"{name}/owner", 0.02)


def assert_recorded(ours: dict[str, torch.Tensor], recorded, key: str, tolerance: float) -> None:
    """Check norms and directions of tensors; those that are zero but for rounding are left out on both sides."""
    found = original_results.kept_of(ours)
    theirs = {name: recorded[f"{key}/{name}"] for name in found}
    assert theirs["names"].tolist() == found["names"].tolist(), key
    zero = original_results.ROUNDING * np.linalg.norm(theirs["norms"])
    small = np.maximum(theirs["norms"], found["norms"]) < zero
    for what, factor in (("norms", 1), ("projections", 4)):  # of which four are rarely farther than 4 norms
        limit = (factor * tolerance * theirs["norms"]).reshape(-1, *[1] * (theirs[what].ndim - 1))
        far = np.abs(found[what] - theirs[what]) > limit
        assert not (far.reshape(len(far), -1).any(1) & ~small).any(), (key, what)


# --- side by side


@pytest.mark.slow
@pytest.mark.parametrize("name", original.POLICIES)
def test_losses_gradients_steps_and_actions_equal_those_of_the_original(name):
    original.original()
    policy, batches = original.our_policy(name, QUICK), given()
    theirs = original.run_original(policy, name, "learn", batches)
    ours = original_results.learn(policy, batches["first"], batches["episode"])
    for key, tolerance in TENSORS.items():
        assert relative(ours[key], torch.from_numpy(theirs[key])) < tolerance, key
    found = {k: original.in_our_names(policy, name, theirs, k) for k in ("gradient", "clipped", "stepped")}
    for kind in ("gradient", "clipped"):
        assert worst(ours[kind], found[kind])[0] < 1e-4, kind
    before = original_results.weights(policy)
    assert update_difference(before, ours["stepped"], found["stepped"], ours["clipped"]) < 1e-3
    statistics = {n: v for n, v in found["stepped"].items() if "running" in n}
    assert statistics and worst(ours["stepped"], statistics)[0] < 1e-5


@pytest.mark.slow
def test_dropout_acts_where_that_of_the_original_does():
    """Both draw the same masks, in the order of their calls."""
    original.original()
    name, batches = "bc_transformer", given()
    policy = original.our_policy(name, QUICK, dropout=True)
    theirs = original.run_original(policy, name, "with_dropout", batches)
    ours = original_results.with_dropout(policy, batches["first"])
    assert relative(ours["dropout_loss"], torch.from_numpy(theirs["dropout_loss"])) < 1e-5
    gradient = original.in_our_names(policy, name, theirs, "dropout_gradient")
    assert worst(ours["dropout_gradient"], gradient)[0] < 1e-4


@pytest.mark.slow
def test_ewc_has_the_fisher_information_the_penalty_and_the_gradients_of_the_original():
    original.original()
    name, batches = "bc_transformer", given()
    policy = original.our_policy(name, QUICK)
    theirs = original.run_original(policy, name, "ewc", batches)
    ours = original_results.ewc(policy, batches["first"], batches["second"])
    assert worst(ours["fisher"], original.in_our_names(policy, name, theirs, "fisher"))[0] < 2e-4
    assert relative(ours["penalty"], torch.from_numpy(theirs["penalty"])) < 1e-4
    gradient = original.in_our_names(policy, name, theirs, "ewc_clipped")
    assert worst(ours["ewc_clipped"], gradient)[0] < 2e-4


@pytest.mark.slow
def test_packnet_has_the_masks_and_the_weights_of_the_original():
    original.original()
    name, batches = "bc_transformer", given()
    policy = original.our_policy(name, QUICK)
    theirs = original.run_original(policy, name, "packnet", batches)
    ours = original_results.packnet(policy, batches["first"], batches["second"])
    owners = original.in_our_names(policy, name, theirs, "owner")
    assert owners.keys() == ours["owner"].keys()
    for layer, owner in owners.items():  # weights at the threshold may be decided by rounding
        assert (ours["owner"][layer] != owner).float().mean() < 5e-4, layer
    for kind in ("packnet_first", "packnet_pruned", "packnet_second"):
        found = original.in_our_names(policy, name, theirs, kind)
        kept = [where_owners_agree(side, ours["owner"], owners) for side in (ours[kind], found)]
        assert worst(*kept)[0] < 1e-3, kind
    fresh = original_results.weights(original.our_policy(name, QUICK))
    statistics = [n for n in fresh if "running" in n]
    assert statistics and all(torch.equal(ours["packnet_second"][n], fresh[n]) for n in statistics)


@pytest.mark.slow
def test_augmentation_has_the_distribution_of_the_original():
    """Colours of a grey-free picture, and shifts of a ramp, in 400 draws of each."""
    original.original()
    policy, window = original.our_policy("bc_transformer", QUICK), picture()
    theirs = original.run_original(
        policy, "bc_transformer", "augmentation", {"first": window}, copies=np.array(400)
    )
    upright = torch.from_numpy(theirs["augmented"]).flip(3) * 255
    augment = build(composed("preset=paper", "compat=libero").augmentation)
    copies = window.observation.images.expand(400, *window.observation.images.shape[1:])
    ours = augment.images(copies, generator(0)).float()
    for number, (a, b) in enumerate(zip(statistics(ours), statistics(upright), strict=True)):
        assert stats.ks_2samp(a, b).pvalue > 1e-3, number
    for seen in (ours, upright):  # one draw for both cameras, which see the same here, and for all frames
        assert (seen[:, :1, :1] - seen).abs().max() < 1.01


def picture():
    """A window of one frame repeated, the same in both views: coloured patches, brighter to the right and below."""
    batch = original.smooth_batch(QUICK, 0, windows=1)
    frame = batch.observation.images[:, :1, :1]
    images = frame.expand(batch.observation.images.shape).contiguous()
    return original.with_images(batch, images)


def statistics(images: torch.Tensor) -> list[np.ndarray]:
    """Means of the channels, their spreads, and places of two pictures' centres, of each draw, (n,)."""
    first = images[:, 0, 0]
    means, spreads = first.mean((1, 2)), first.std((1, 2))
    weight = first.sum(-1)
    place = torch.linspace(-1, 1, first.shape[1])
    rows, columns = weight.sum(2), weight.sum(1)
    centres = [(part * place).sum(1) / part.sum(1) for part in (rows, columns)]
    return [x.numpy() for x in (*means.T, *spreads.T, *centres)]


def test_shifts_are_shared_by_views_and_frames_and_never_reach_the_last_place():
    """The original crops at floor(8 u) of a picture with the bottom row first."""
    ramp = torch.arange(64, dtype=torch.uint8)
    rows = ramp[:, None].expand(64, 64)
    images = torch.stack([rows, rows.T, rows], -1).expand(300, 2, 2, 64, 64, 3)
    moved = SharedShift(4).images(images, generator(0))
    assert (moved == moved[:, :1, :1]).all()
    down, right = (moved[:, 0, 0, 32, 32, channel].int() - 32 for channel in range(2))
    assert sorted(set(down.tolist())) == list(range(-3, 5))
    assert sorted(set(right.tolist())) == list(range(-4, 4))
    assert np.corrcoef(down, right)[0, 1] ** 2 < 0.05
