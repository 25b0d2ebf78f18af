"""What ids of LIBERO-Plus mean: cameras, arms and noise, against numbers of its code.

The numbers are printed by `python experiments/robustness/plus_beside_theirs.py --record`, in its environment.
"""

import numpy as np
import pytest

from libero_env.errors import InvalidInputError, UnknownNameError
from libero_env.perturbations.corruptions import CORRUPTIONS, SEVERITIES, corrupt
from libero_env.published import camera_pose, joint_pose, parse_plus_id
from libero_env.published.plus import NOISES, Noise, ViewChange

BASE = "put_the_bowl_on_the_plate"
IDS = {
    f"{BASE}_view_285_15_100_0_0_initstate_0": ("camera", BASE, {"view": ViewChange(285, 15)}),
    f"{BASE}_view_0_0_137_0_0_initstate_0": ("camera", BASE, {"view": ViewChange(distance=1.37)}),
    f"{BASE}_view_0_0_100_358_10_initstate_0": ("camera", BASE, {"view": ViewChange(turn=358, tilt=10)}),
    f"{BASE}_view_0_0_100_0_0_initstate_13": ("robot", BASE, {"pose": 13}),
    f"{BASE}_view_0_0_100_0_0_initstate_0_noise_1": ("noise", BASE, {"noise": Noise("motion", 1)}),
    f"{BASE}_view_0_0_100_0_0_initstate_0_noise_20": ("noise", BASE, {"noise": Noise("gaussian", 10)}),
    f"{BASE}_view_0_0_100_0_0_initstate_0_noise_41": ("noise", BASE, {"noise": Noise("glass", 1)}),
    f"{BASE}_language_7_view_0_0_100_0_0_initstate_0": ("language", f"{BASE}_language_7", {"language": 7}),
    f"{BASE}_light_50": ("light", None, {"scenery": "light"}),
    f"{BASE}_table_3": ("background", None, {"scenery": "table"}),
    f"{BASE}_tb_23": ("background", None, {"scenery": "table_and_wall"}),
    f"{BASE}_add_10": ("layout", None, {"scenery": "added"}),
    f"{BASE}_level1_sample2": ("layout", None, {"scenery": "moved"}),
    f"{BASE}_moved_level1_sample2": ("layout", None, {"scenery": "goal_moved"}),
}
# Workspace, move of the camera, their position and quaternion (wxyz)
CAMERAS = (
    ("table", ViewChange(), [0.6586, 0.0, 1.6104], [0.638, 0.3048, 0.3048, 0.638]),
    ("table", ViewChange(300, 15), [0.2132, -0.3693, 1.7532], [-0.9184, -0.2991, -0.0802, -0.2461]),
    ("table", ViewChange(distance=1.37), [0.9023, 0.0, 1.9102], [0.638, 0.3048, 0.3048, 0.638]),
    ("table", ViewChange(turn=354, tilt=8), [0.6586, 0.0, 1.6104], [-0.689, -0.2775, -0.2409, -0.6246]),
    ("kitchen_table", ViewChange(300, 15), [0.2132, -0.3693, 1.7532], [-0.9184, -0.2991, -0.0802, -0.2461]),
    ("living_room_table", ViewChange(300, 15), [0.2723, -0.4716, 1.1115], [-0.8985, -0.3546, -0.095, -0.2407]),
    ("study_table", ViewChange(distance=1.37), [0.6283, 0.0, 1.9102], [0.638, 0.3048, 0.3048, 0.638]),
    ("floor", ViewChange(300, 15), [0.4525, -0.7837, 0.8872], [-0.8985, -0.3546, -0.095, -0.2407]),
    ("floor", ViewChange(turn=354, tilt=8), [0.8966, 0.0, 0.65], [-0.6708, -0.319, -0.2787, -0.6088]),
)  # fmt: skip
JOINTS = {
    1: [0.02097405, -0.16687568, 0.02734903, -2.38028663, -0.00988726, 2.21686563, 0.85208136],
    250: [0.16418848, -0.29208442, 0.03368463, -2.30678939, 0.07081111, 2.25354254, 0.92685897],
    500: [-0.11827633, -0.04802337, 0.42756544, -2.2644154, -0.01062499, 2.18628575, 0.7065925],
}
# Number of the noise -> mean, and pixels (3, 5), (100, 30) and (200, 219), of a synthetic image under seed 7
NOISY = {
    1: (126.83532206217448, [177, 69, 122], [115, 168, 206], [171, 139, 113]),
    10: (126.82857259114583, [131, 124, 140], [122, 143, 145], [118, 135, 133]),
    11: (126.83319091796875, [129, 110, 119], [86, 134, 182], [153, 79, 106]),
    16: (126.83535257975261, [118, 130, 130], [127, 133, 137], [131, 136, 123]),
    21: (126.81611633300781, [139, 112, 118], [121, 145, 152], [149, 110, 129]),
    30: (126.82801310221355, [122, 114, 131], [118, 143, 141], [141, 125, 142]),
    31: (131.11904907226562, [208, 72, 108], [93, 129, 164], [211, 76, 111]),
    38: (130.54595947265625, [198, 158, 168], [96, 107, 118], [114, 74, 84]),
    41: (126.37550862630208, [160, 76, 109], [67, 117, 170], [67, 85, 133]),
    47: (126.35001627604167, [132, 127, 122], [127, 136, 140], [130, 137, 122]),
}


@pytest.mark.parametrize("name", IDS)
def test_an_id_says_what_is_changed_and_of_what(name):
    kind, file, changed = IDS[name]
    variant = parse_plus_id(name)
    assert (variant.name, variant.base, variant.kind, variant.file) == (name, BASE, kind, file or name)
    values = {"view": ViewChange(), "pose": 0, "noise": None, "language": None, "scenery": None, **changed}
    assert {key: getattr(variant, key) for key in values} == values


def test_words_of_a_tasks_name_are_not_taken_for_an_ending():
    base = "pick_up_the_black_bowl_from_table_center_and_place_it_on_the_plate"
    assert parse_plus_id(f"{base}_table_11").base == base
    assert parse_plus_id(f"{base}_view_0_0_100_0_0_initstate_1").base == base


@pytest.mark.parametrize("name", [
    *(BASE, "", "_light_1", f"{BASE}_light_", f"{BASE}_light_x", f"{BASE}_table_\u0661"),
    *(f"{BASE}_view_0_0_100_0_0", f"{BASE}_view_0_0_100_0_0_initstate_501"),
    f"{BASE}_view_0_0_100_0_0_initstate_0_noise_51",
])  # fmt: skip
def test_what_is_no_id_is_told_in_one_line(name):
    with pytest.raises(InvalidInputError) as error:
        parse_plus_id(name)
    assert "\n" not in str(error.value) and "LIBERO-Plus" in str(error.value)


@pytest.mark.parametrize(("workspace", "view", "pos", "quat"), CAMERAS)
def test_cameras_are_where_their_code_puts_them(workspace, view, pos, quat):
    pose = camera_pose(workspace, view)
    np.testing.assert_allclose(pose.pos, pos, rtol=0, atol=1e-9)
    np.testing.assert_allclose(pose.quat_wxyz, quat, rtol=0, atol=1e-9)


def test_arms_are_where_their_code_puts_them():
    for number, joints in JOINTS.items():
        np.testing.assert_allclose(joint_pose(number), joints, rtol=0, atol=1e-12)
    distances = [np.linalg.norm(joint_pose(n) - joint_pose(0)) for n in range(1, 501)]
    np.testing.assert_allclose(distances, np.repeat([0.1, 0.2, 0.3, 0.4, 0.5], 100), atol=3e-8)
    joint_pose(1)[:] = 0.0
    assert joint_pose(1).any()


@pytest.mark.parametrize("number", NOISY)
def test_noise_is_that_of_their_code(number):
    kind, severity = divmod(number - 1, SEVERITIES)
    noisy = corrupt(synthetic_image(), NOISES[kind], severity + 1, legacy_generator(7))
    mean, *pixels = NOISY[number]
    found = [noisy[3, 5], noisy[100, 30], noisy[200, 219]]
    # np.exp of other versions of NumPy differs in the last bit, and so numbers that are rounded down
    level, share = (0, 1e-9) if NOISES[kind] in ("zoom", "fog") else (1, 0.02)
    assert np.abs(np.array(found, int) - pixels).max() <= level
    assert noisy.mean() == pytest.approx(mean, abs=share)


@pytest.mark.parametrize("kind", CORRUPTIONS)
def test_noise_takes_images_of_any_size_and_leaves_them(kind):
    image = synthetic_image()[:64, :80]
    before = image.copy()
    one, two = (corrupt(image, kind, 3, np.random.default_rng(1)) for _ in range(2))
    np.testing.assert_array_equal(one, two)
    np.testing.assert_array_equal(image, before)
    assert one.shape == image.shape and one.dtype == np.uint8 and (one != image).mean() > 0.1


def test_noise_that_does_not_exist_is_refused():
    image, rng = synthetic_image(), np.random.default_rng(0)
    with pytest.raises(UnknownNameError, match="motion"):
        corrupt(image, "snow", 1, rng)
    with pytest.raises(InvalidInputError, match="1 to 10"):
        corrupt(image, "fog", 11, rng)
    with pytest.raises(InvalidInputError, match="uint8"):
        corrupt(image / 255.0, "fog", 1, rng)


def synthetic_image() -> np.ndarray:
    """Return the image of the script that recorded the numbers."""
    row, column, channel = np.indices((256, 256, 3))
    return ((37 * row + 101 * column + 53 * channel + 7 * row * column) % 256).astype(np.uint8)


def legacy_generator(seed: int) -> np.random.Generator:
    """Return a generator of the random numbers that `np.random.seed(seed)` starts."""
    bits = np.random.MT19937()
    bits.state = np.random.RandomState(seed).get_state(legacy=False)
    return np.random.Generator(bits)
