"""Policies of LeRobot (huggingface/lerobot), such as ACT and diffusion policies, as policies of this package.

LeRobot's own classes compute losses and actions; here windows become its batches. `make lerobot` makes an environment
with it, because it asks for other versions of some packages.

Shape legend: B batch, T steps of a window, A action, D sizes of all readings, L language embedding.
"""

import inspect
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from libero_env.storage import own_folder
from libero_integrations.lerobot_modules import lerobot_module
from lifelong.data.windows import WindowDataset
from lifelong.errors import CheckpointError, ConfigError, PolicyError
from lifelong.policies.base import Policy
from lifelong.types import Batch, Count, Observation, PolicySpec, Unfinished

# type -> its setting for the number of actions in a chunk, which is the length of a window
CHUNKS = dict.fromkeys(("act", "smolvla", "pi0", "pi0_fast", "pi05", "xvla"), "chunk_size")
CHUNKS |= {"diffusion": "horizon", "vqbet": "action_chunk_size"}
# they read the instruction's embedding as observation.environment_state
WITH_EMBEDDING = ("act", "diffusion")
WITH_TEXT = ("smolvla", "pi0", "pi0_fast", "pi05", "xvla")  # they read the instruction as text
DEFAULTS: Mapping[str, Mapping[str, Any]] = {
    "act": {"pretrained_backbone_weights": None},
    # a chunk's actions follow from its first noise alone, so they do not depend on what else is simulated
    "diffusion": {
        "noise_scheduler_type": "DDIM",
        "num_inference_steps": 10,
        "crop_shape": None,
        "pretrained_backbone_weights": None,
        "use_group_norm": True,  # running statistics of batches would drift from task to task
    },
}
# of LeRobot's data sets of LIBERO
IMAGES = {"agentview_rgb": "observation.images.image", "eye_in_hand_rgb": "observation.images.image2"}
STATE, EMBEDDING, ACTION = "observation.state", "observation.environment_state", "action"
FOLDER = "lerobot"  # in a run's directory, in LeRobot's format
_IMAGENET = {"mean": (0.485, 0.456, 0.406), "std": (0.229, 0.224, 0.225)}
_TASKS, _LETTERS = 256, 256  # instructions that a policy can remember, and bytes of each
_KINDS = ("mean", "std", "min", "max")
# settings whose texts choose among LeRobot's own functions
_LOADS_NOTHING = """
    beta_schedule feedforward_activation noise_scheduler_type normalization_mapping prediction_type vision_backbone
""".split()  # noqa: SIM905


class LeRobotPolicy(Policy):
    """A policy of LeRobot.

    Its window begins with the frames that it observes, and its chunk is as long as the window, `data.seq_len`; what
    is past a demonstration's end does not count. Losses are LeRobot's, to the bit. After each task the policy is
    saved in LeRobot's format, too, in `lerobot/` of the run's directory, which LeRobot loads and evaluates.

    Args:
        spec: What the policy observes and does.
        type: LeRobot's name of the policy, such as `act` or `diffusion`.
        settings: Fields of LeRobot's configuration of that type.
        act_steps: Number of actions of a chunk that are executed before the next is planned; None for all.
        language: Whether policies without text read the instruction's embedding, as `observation.environment_state`.
        pretrained: Folder, or name on the Hugging Face Hub, of a policy to begin with; it has its own settings.

    Raises:
        MissingPackageError: LeRobot is not installed.
        ConfigError: There is no such type, or a setting is not valid.
    """

    @classmethod
    def loads_from_elsewhere(cls, values: Mapping[str, Any]) -> tuple[str, str]:
        """Return the package, and the first key by which it would load files that a configuration names; "" for none.

        Policies that read text have a tokenizer and a language model. Of the others only numbers and names of
        functions are known to load nothing.
        """
        settings = values.get("settings")
        plain = settings if isinstance(settings, Mapping) else {}
        unknown = {key: value for key, value in plain.items() if key not in _LOADS_NOTHING}
        named = [f"settings.{key}" for key, value in unknown.items() if _has_text(value)]
        pretrained = [] if values.get("pretrained") is None else ["pretrained"]
        with_text = [] if values.get("type") in ("act", "diffusion", "vqbet") else ["type"]
        return "lerobot", next(iter([*pretrained, *with_text, *named]), "")

    @classmethod
    def saved_arguments(cls, values: Mapping[str, Any], folder: Path) -> Mapping[str, Any]:
        """Return the arguments with what `save_beside` wrote in place of `pretrained`; see `Policy`.

        Raises:
            CheckpointError: It is not there.
        """
        if values.get("pretrained") is None:
            return values
        saved = own_folder(folder, FOLDER, error=CheckpointError)
        if not saved.is_dir():
            raise CheckpointError(f"{saved} is missing, in which the run saved its policy")
        return {**values, "pretrained": str(saved)}

    by_window = False  # the axis of time comes first in ACT's layers
    statistics = "first"

    def __init__(
        self,
        *,
        spec: PolicySpec,
        type: str,
        settings: Mapping[str, Any],
        act_steps: Count | None,
        language: bool,
        pretrained: str | None,
    ) -> None:
        super().__init__(spec)
        self.type = type
        self.language = language and type in WITH_EMBEDDING
        given = {"policy.act_steps": act_steps, "policy.settings": settings or None}
        if pretrained is not None and (own := [name for name, value in given.items() if value is not None]):
            raise ConfigError(f"policy.pretrained={pretrained} has its settings: leave out {', '.join(own)}")
        if act_steps is not None and "n_action_steps" in settings:
            raise ConfigError("policy.act_steps is policy.settings.n_action_steps: leave out one of them")
        try:
            self.inner = self._build(settings, act_steps, pretrained)
        except (ValueError, NotImplementedError, TypeError) as error:
            text = " ".join(str(error).split())
            raise ConfigError(f"policy.type={type}: LeRobot refuses its settings: {text}") from error
        self._frames = list(self.inner.config.observation_delta_indices or [0])
        self._first = min(*self._frames, *self.inner.config.action_delta_indices)
        longest = max(*self._frames, *self.inner.config.action_delta_indices) - self._first + 1
        if longest != spec.seq_len:
            raise ConfigError(
                f"policy.type={type} learns from windows of {longest} steps, and data.seq_len is {spec.seq_len}; "
                f"set data.seq_len={longest}"
            )
        sizes = sum(spec.proprio.values()) + spec.action_dim
        self.register_buffer("moments", torch.zeros(len(_KINDS), sizes))
        self.register_buffer("met", torch.zeros((), dtype=torch.int64))  # number of tasks
        self.register_buffer("keys", torch.zeros(_TASKS, spec.language_dim))
        self.register_buffer("texts", torch.zeros(_TASKS, _LETTERS, dtype=torch.uint8))
        self._processors: tuple[Any, tuple[Any, Any]] | None = None

    def _build(self, settings: Mapping[str, Any], act_steps: int | None, pretrained: str | None) -> Any:
        factory = lerobot_module("policies.factory")
        policy_class = factory.get_policy_class(self.type)
        if pretrained is not None and torch.empty(0).is_meta:  # its size is asked for
            configs = lerobot_module("configs.policies")
            return policy_class(configs.PreTrainedConfig.from_pretrained(pretrained))
        if pretrained is not None:
            return policy_class.from_pretrained(pretrained)
        chunk = {CHUNKS[self.type]: self.spec.seq_len} if self.type in CHUNKS else {}
        known = policy_class.config_class.__dataclass_fields__
        if unknown := sorted(set(settings) - set(known)):
            raise ConfigError(
                f"policy.settings.{unknown[0]} is not a setting of LeRobot's {self.type}; valid: {', '.join(known)}"
            )
        chosen = {**DEFAULTS.get(self.type, {}), **chunk, **settings}
        if "n_action_steps" in known:
            frames = chosen.get("n_obs_steps", known["n_obs_steps"].default)
            chosen.setdefault("n_action_steps", act_steps or self.spec.seq_len - frames + 1)
        own = {**chosen, **self._features(), "device": "cpu", "push_to_hub": False}
        return policy_class(factory.make_policy_config(self.type, **own))

    @property
    def _images(self) -> list[str]:
        """LeRobot's names of the views."""
        return [IMAGES.get(view, f"observation.images.{view}") for view in self.spec.views]

    def _features(self) -> dict[str, dict[str, Any]]:
        types = lerobot_module("configs.types")
        feature, kind = types.PolicyFeature, types.FeatureType
        inputs = {key: feature(kind.VISUAL, (3, *self.spec.image_size)) for key in self._images}
        inputs[STATE] = feature(kind.STATE, (sum(self.spec.proprio.values()),))
        if self.language:
            inputs[EMBEDDING] = feature(kind.ENV, (self.spec.language_dim,))
        actions = {ACTION: feature(kind.ACTION, (self.spec.action_dim,))}
        return {"input_features": inputs, "output_features": actions}

    def meet_task(self, dataset: WindowDataset, instruction: str) -> None:
        """Take note of the text of the instruction; see `Policy`."""
        embedding = dataset.batch(torch.zeros(1, dtype=torch.int64)).observation.language[0]
        number, text = int(self.met), instruction.encode()
        if (self.keys[:number] == embedding.to(self.keys)).all(1).any():
            return  # it is known
        if number == _TASKS or len(text) > _LETTERS:
            raise PolicyError(
                f"LeRobotPolicy remembers {_TASKS} instructions of {_LETTERS} bytes; this is number {number + 1}, "
                f"of {len(text)} bytes"
            )
        self.keys[number] = embedding.to(self.keys)
        self.texts[number, : len(text)] = torch.tensor(list(text), dtype=torch.uint8).to(self.texts.device)
        self.met.add_(1)

    def normalise(self, moments: Tensor, *, once: bool) -> None:
        """Normalise readings and actions by statistics; see `Policy`."""
        if not (once and bool(self.moments.any())):
            self.moments.copy_(moments)

    def instructions(self, language: Tensor) -> list[str]:
        """Return the texts of embeddings (B, L).

        Raises:
            PolicyError: One is of no task that the policy has met.
        """
        texts = []
        for embedding in language:
            same = (self.keys[: int(self.met)] == embedding.to(self.keys)).all(1).nonzero()
            if not len(same):
                raise PolicyError(
                    f"policy.type={self.type} reads texts of instructions, and has not learned a task of this one"
                )
            letters = bytes(self.texts[int(same[-1])].tolist())
            texts.append(letters.rstrip(b"\0").decode())
        return texts

    def loss(self, batch: Batch) -> Tensor:
        """Return LeRobot's loss of a batch, a scalar."""
        with self._learning():
            return self.inner(self.to_lerobot(batch))[0]

    def window_losses(self, batch: Batch) -> Tensor:
        """Return the loss of each window, one by one: LeRobot computes that of a batch; see `Policy`."""
        return torch.stack([self.loss(batch.rows(slice(k, k + 1))) for k in range(len(batch))])

    def predict(self, batch: Batch) -> Tensor:
        """Return the chunk that is planned at each window's first frame; see `Policy`.

        Raises:
            PolicyError: The policy's chunks are random.
        """
        if self._takes_noise:
            raise PolicyError(
                f"policy.type={self.type} draws its actions, so there is no mean action to distil: choose another "
                "algorithm, or policy.type=act"
            )
        plan = inspect.unwrap(self.inner.__class__.predict_action_chunk)  # with gradients
        modes = [(module, module.training) for module in self.inner.modules()]
        chunk = plan(self.inner, self.to_lerobot(batch, actions=False))
        for module, mode in modes:  # which LeRobot has set to evaluation
            module.training = mode
        return self._unnormalised(chunk)

    def reset(self, num_envs: int) -> None:
        """Forget the past; see `Policy`."""
        self.inner.reset()

    def _act(self, observation: Observation, generators: Sequence[torch.Generator] | None) -> Tensor:
        batch = self.processors()[0](self._observed(observation, [0], squeeze=True))
        if not self._takes_noise:
            return self._unnormalised(self.inner.select_action(batch))
        if generators is None:
            raise PolicyError(f"policy.type={self.type} draws its actions: act(..., generators=[...])")
        size = (self.inner.config.max_action_dim if self.type in WITH_TEXT else self.spec.action_dim,)
        steps = getattr(self.inner.config, CHUNKS[self.type])
        noise = torch.stack([torch.randn(steps, *size, generator=g) for g in generators])
        return self._unnormalised(self.inner.select_action(batch, noise=noise.to(observation.language)))

    def _plan(
        self,
        observation: Observation,
        rows: Sequence[int],
        generators: Sequence[torch.Generator] | None,
        before: Mapping[int, Unfinished] | None,
    ) -> Tensor:
        """Return what LeRobot would execute of a chunk that it plans now; see `Policy`."""
        queue = getattr(self.inner, "_action_queue", None)
        queue = getattr(self.inner, "_queues", {}).get(ACTION) if queue is None else queue
        if rows and queue is not None:
            queue.clear()
        first = self._act(observation, generators)
        return torch.stack([first, *map(self._unnormalised, queue or ())], dim=1)[list(rows)]

    @property
    def execute(self) -> int:  # type: ignore[override]
        """Number of actions that are executed before it plans again."""
        return getattr(self.inner.config, "n_action_steps", 1)

    @property
    def chunk(self) -> int:  # type: ignore[override]
        """Number of actions that `plan` returns, those that are executed."""
        return self.execute

    @property
    def _takes_noise(self) -> bool:
        plan = inspect.signature(self.inner.__class__.predict_action_chunk).parameters
        return "noise" in plan or self.type in ("smolvla", "pi0", "pi05")

    def to_lerobot(self, batch: Batch, *, actions: bool = True) -> dict[str, Any]:
        """Return a batch as LeRobot's policy takes it, normalised.

        Args:
            batch: Windows.
            actions: Whether the actions to be learned are among it.
        """
        given = self._observed(batch.observation, [k - self._first for k in self._frames])
        if actions:
            steps = [k - self._first for k in self.inner.config.action_delta_indices]
            given[ACTION], given["action_is_pad"] = batch.actions[:, steps], batch.padding()[:, steps]
        return self.processors()[0](given)

    def _observed(
        self, observation: Observation, frames: Sequence[int], *, squeeze: bool = False
    ) -> dict[str, Any]:
        """Return frames of an observation with LeRobot's names, images (B, frames, C, H, W) in [0, 1].

        There is no axis of frames for policies that see one, or where `squeeze` is set.
        """
        single = squeeze or self.inner.config.observation_delta_indices is None
        pick = lambda x: x[:, frames[0]] if single else x[:, list(frames)]  # noqa: E731
        images = pick(observation.images)
        given: dict[str, Any] = {
            key: images[..., k, :, :, :].movedim(-1, -3).float() / 255 for k, key in enumerate(self._images)
        }
        given[STATE] = pick(torch.cat([observation.proprio[name] for name in self.spec.proprio], dim=-1))
        if self.language:
            embedding = observation.language.float()
            given[EMBEDDING] = embedding if single else embedding[:, None].expand(-1, len(frames), -1)
        if self.type in WITH_TEXT:
            given["task"] = self.instructions(observation.language)
        return given

    def _unnormalised(self, actions: Tensor) -> Any:
        return self.processors()[1](actions).to(actions.device)

    def processors(self) -> tuple[Any, Any]:
        """Return LeRobot's processors of what goes in and of the actions that come out."""
        key = (self.moments._version, self.moments.data_ptr(), str(self.moments.device))
        if self._processors is None or self._processors[0] != key:
            make = lerobot_module("policies.factory").make_pre_post_processors
            self.inner.config.device = self.moments.device.type
            self._processors = (key, make(self.inner.config, dataset_stats=self.lerobot_statistics()))
        return self._processors[1]

    def lerobot_statistics(self) -> dict[str, dict[str, Tensor]]:
        """Return the statistics as LeRobot has them; of images those of ImageNet, its default."""
        colours = {name: torch.tensor(values).view(3, 1, 1) for name, values in _IMAGENET.items()}
        statistics = dict.fromkeys(self._images, colours)
        if not bool(self.moments.any()):
            return statistics
        moments, count = self.moments.detach().cpu(), self.spec.action_dim
        parts = {STATE: moments[:, :-count], ACTION: moments[:, -count:]}
        return statistics | {key: dict(zip(_KINDS, part, strict=True)) for key, part in parts.items()}

    def rate_factors(self) -> Mapping[str, float]:
        """Return the factors of the learning rate that LeRobot's optimiser groups have; see `Policy`."""
        base = getattr(self.inner.config, "optimizer_lr", None)
        names = {id(p): f"inner.{name}" for name, p in self.inner.named_parameters()}
        factors: dict[str, float] = {}
        for group in self.inner.get_optim_params():
            if isinstance(group, dict) and base and group.get("lr") not in (None, base):
                factors |= {names[id(p)]: group["lr"] / base for p in group["params"]}
        return factors

    def save_beside(self, folder: Path) -> None:
        """Write the policy as LeRobot saves it, with its processors, into `lerobot/` of a folder; see `Policy`."""
        new, place = folder / f".{FOLDER}.part", folder / FOLDER
        shutil.rmtree(new, ignore_errors=True)
        for part in (self.inner, *self.processors()):
            part.save_pretrained(new)
        shutil.rmtree(place, ignore_errors=True)
        new.rename(place)

    @contextmanager
    def _learning(self) -> Iterator[None]:
        """Let ACT compute its loss in evaluation mode, too, where it would leave its variational encoder out."""
        model = getattr(self.inner, "model", None) if self.type == "act" else None
        if model is None:
            yield
            return
        before, model.training = model.training, True
        try:
            yield
        finally:
            model.training = before


def _has_text(value: Any) -> bool:
    if isinstance(value, Mapping):
        return any(map(_has_text, value.values()))
    return any(map(_has_text, value)) if isinstance(value, list | tuple) else isinstance(value, str)
