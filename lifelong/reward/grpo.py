"""Group-relative policy optimisation: episodes from equal starts are compared, and the better ones become likelier.

Shao et al., "DeepSeekMath" (2402.03300), without its critic, and with the changes of Yu et al., "DAPO" (2503.14476):
the upper clip is wider, groups without spread are left out, and every frame of a batch weighs the same.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from copy import deepcopy
from itertools import count
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from libero_env.validation import checked
from lifelong.algorithms.frozen_base import RoutedExperts
from lifelong.checkpoints import load_weights
from lifelong.context import RunContext
from lifelong.errors import ConfigError
from lifelong.evaluation.beside import RolloutProcess
from lifelong.nn.heads import GMMHead
from lifelong.policies.base import has_hooks, in_mode
from lifelong.policies.history import HistoryPolicy
from lifelong.results.records import CollectionRecord
from lifelong.reward.experience import Collected, Experience, collect
from lifelong.seeding import generator
from lifelong.training.memory import check_memory
from lifelong.types import Batch, Count, NonNegative, Share


def group_advantages(rewards: Tensor) -> Tensor:
    """Return by how many standard deviations of its group each episode is better than the group's mean, (G, E).

    Zero in groups without spread; an episode without a reward (NaN) counts in no mean, and has none.

    Args:
        rewards: (G, E), the episodes of a row from the same start.
    """
    valid = ~rewards.isnan()
    mean = rewards.nanmean(1, keepdim=True)
    deviation = (rewards - mean).square().nanmean(1, keepdim=True).sqrt()
    return torch.where(valid & (deviation > 0), (rewards - mean) / deviation, 0.0)


def clipped_loss(now: Tensor, drawn: Tensor, advantages: Tensor, low: float, high: float) -> Tensor:
    """Return -mean(min(r A, clip(r, 1 - low, 1 + high) A)), with r the ratio of probabilities now and when drawn.

    Schulman et al., "Proximal policy optimization algorithms" (1707.06347), eq. 7; a scalar.

    Args:
        now: Log-probabilities of actions now, (B,), with gradients.
        drawn: Those when they were drawn, (B,).
        advantages: (B,).
    """
    ratio = (now - drawn).exp()
    return -torch.minimum(ratio * advantages, ratio.clamp(1 - low, 1 + high) * advantages).mean()


@checked
class GRPO:
    """Learns each stage from the success of the policy's own episodes.

    An epoch of training is an iteration: `starts` initial states are sampled, `episodes` episodes are run from each
    with drawn actions, and `train.steps_per_epoch` steps of `train.batch_size` frames follow. The initial states are
    none of the stored ones, by which success is measured. Augmentation and dropout are off, so that the policy that
    learns is the one that acted. Of demonstrations only what an algorithm keeps of them is learned, with `replay`.

    Attributes:
        starts: Number of initial states of each task in an iteration.
        episodes: Number of episodes from each.
        clip_low: How far below 1 the ratio of probabilities counts.
        clip_high: How far above 1 it counts.
        kl: Weight of the divergence from the policy that began the phase of training, by the estimate k3 of Schulman
            (2020), "Approximating KL divergence".
        replay: Weight of the loss on the windows that an algorithm adds to batches, such as `er`.
        processes: Number of processes that run the episodes, each a share of them; results depend on it in bits.
    """

    starts: Count = 16
    episodes: Annotated[int, Field(ge=2, le=1_000_000)] = 8
    clip_low: Share = 0.2
    clip_high: NonNegative = 0.28
    kl: NonNegative = 0.0
    replay: NonNegative = 0.0
    processes: Annotated[int, Field(ge=1, le=64)] = 2

    def __post_init__(self) -> None:
        if self.starts * self.episodes % self.processes:
            raise ConfigError(
                f"learner.processes is {self.processes}, which does not divide {self.starts * self.episodes} episodes"
            )

    def check(self, context: RunContext) -> None:
        """Check that a run can learn so.

        Raises:
            ConfigError: The policy has no log-probabilities of single frames' actions, the algorithm would add windows
                that nothing learns, or another setting has no meaning here.
        """
        policy, algorithm = context.policy, context.algorithm
        head = policy.head if isinstance(policy, HistoryPolicy) else None
        if not isinstance(head, GMMHead):
            raise ConfigError(
                "learner=grpo needs the log-probability of an action: a policy of this package with policy/head=gmm"
            )
        if head.low_eval_noise:
            raise ConfigError(
                "learner=grpo needs actions that are drawn as they are learned: policy.head.low_eval_noise=false"
            )
        if policy.spec.seq_len != 1:
            raise ConfigError(
                f"data.seq_len is {policy.spec.seq_len}: learner=grpo learns from single frames, data.seq_len=1"
            )
        name = type(algorithm).__name__
        if algorithm.needs_demonstrations:
            raise ConfigError(
                f"{name} needs windows of demonstrations, and learner=grpo has none of the present task"
            )
        if self.kl and isinstance(algorithm, RoutedExperts):
            raise ConfigError(
                f"learner.kl compares with weights, and {name} acts with experts beside them: set it to 0"
            )
        if context.fit.precision != context.eval.precision:
            raise ConfigError(
                f"train.precision={context.fit.precision} and eval.precision={context.eval.precision}: learner=grpo "
                "compares probabilities when acting and when learning, which need the same"
            )
        if algorithm.adds_windows != bool(self.replay):
            raise ConfigError(
                f"learner.replay is {self.replay:g}, and {name} adds no windows to batches: set it to 0"
                if self.replay
                else f"{name} adds windows to batches, which nothing learns with learner.replay=0: give it a weight"
            )
        if context.stream.blur:
            raise ConfigError(
                "stream.blur mixes demonstrations, of which learner=grpo learns none: set it to 0"
            )
        if not context.fit.steps_per_epoch:
            raise ConfigError("learner=grpo needs train.steps_per_epoch, the number of steps of an iteration")
        if self.replay and context.fit.accumulate > 1:
            raise ConfigError("learner.replay weighs a whole batch: train.accumulate=1")
        if context.ranks.size > 1:
            raise ConfigError("learner=grpo learns in one process: start it without torchrun")
        height, width = policy.spec.image_size
        frames = self.starts * self.episodes * context.eval.horizon * max(context.group_sizes)
        what = (
            f"the images of an iteration (learner.starts={self.starts}, learner.episodes={self.episodes}, "
            f"eval.horizon={context.eval.horizon})"
        )
        check_memory({what: frames * len(policy.spec.views) * height * width * 3})

    @contextmanager
    def training(
        self,
        context: RunContext,
        stage: Sequence[int],
        seed: Sequence[int],
        resume: Mapping[str, Any] | None,
        offset: int = 0,
    ) -> Iterator[dict[str, Any]]:
        """Yield what `lifelong.training.fit.fit` needs to learn a stage so.

        Args:
            stage: Positions of the tasks.
            seed: Integers that identify the call within the run.
            resume: State of `fit` that it goes on from; None from the start.
            offset: Number of epochs of the stage's earlier phases.
        """
        policy = context.policy
        assert isinstance(policy, HistoryPolicy)
        reference = deepcopy(policy) if self.kl else None
        if reference is not None and resume is not None:
            load_weights(reference, resume["reference"], "the training state")
        with ExitStack() as stack:
            others = [stack.enter_context(RolloutProcess(context.envs)) for _ in range(self.processes - 1)]
            epochs = count(resume["epoch"] if resume else 0)

            def load(chunks: Sequence[Tensor]) -> Iterator[Batch]:
                epoch = next(epochs)
                began = time.perf_counter()
                first, *rest = [self._collect(context, task, (*seed, epoch), others) for task in stage]
                done = first.join(*rest)
                frames, record = self._kept(done), self._record(done)
                del first, rest, done  # as large as what is kept of them
                seconds = time.perf_counter() - began
                log = context.directory.log
                number = offset + epoch + 1
                known = {(r.task, r.epoch) for r in log.read().of(CollectionRecord)}
                if (stage[-1], number) not in known:
                    log.append(CollectionRecord(task=stage[-1], epoch=number, seconds=seconds, **record))
                yield from _batches(frames, [len(chunk) for chunk in chunks])

            yield {
                "augment": None,
                "load": load,
                "objective": lambda batch: self.loss(policy, batch, reference),
                "more": {"reference": reference.state_dict()} if reference is not None else {},
            }

    def loss(self, policy: HistoryPolicy, batch: Batch, reference: HistoryPolicy | None = None) -> Tensor:
        """Return what a step minimises, a scalar.

        Args:
            batch: Experience, perhaps followed by windows of demonstrations.
            reference: Policy that began the phase, where `kl` is not 0.
        """
        assert isinstance(batch, Experience) and isinstance(policy.head, GMMHead)
        own = ~batch.log_probs.isnan()
        with in_mode(policy, training=False):  # as it acted
            params = policy.distribution(batch.observation)
            now = policy.head.log_prob(params, batch.actions)[:, 0]
            loss = clipped_loss(
                now[own], batch.log_probs[own], batch.advantages[own], self.clip_low, self.clip_high
            )
            if not own.all():
                loss = loss + self.replay * policy.head.losses(params, batch.actions)[~own].mean()
        if reference is not None and isinstance(reference.head, GMMHead):
            with torch.no_grad(), in_mode(reference, training=False):
                params = reference.distribution(batch.observation)
                before = reference.head.log_prob(params, batch.actions)[:, 0]
            change = (before - now)[own]
            loss = loss + self.kl * (change.exp() - change - 1).mean()
        return loss

    def _collect(
        self, context: RunContext, task: int, seed: Sequence[int], others: Sequence[RolloutProcess]
    ) -> Collected:
        """Run the episodes of a task, a share of them in each process; the bits do not tell where."""
        seeds = torch.randint(2**31, (self.starts,), generator=generator(*seed, 2, task)).tolist()
        starts = [start for start in seeds for _ in range(self.episodes)]
        size, settings = len(starts) // self.processes, context.eval
        told = {
            "language": context.languages[task],
            "task": task,
            "horizon": settings.horizon,
            "settle_steps": settings.settle_steps,
            "precision": settings.precision,
        }
        key, apart = (task, size), context.device.type == "cpu" and not has_hooks(context.policy)
        here: list[Collected] = []
        elsewhere: list[Callable[[], Collected]] = []
        for part, share in reversed(list(enumerate(torch.tensor(starts).split(size)))):
            options = {**told, "draws": generator(*seed, 3, task, part)}
            if part and apart:
                sent = others[part - 1].submit(collect, context.policy, key, share.tolist(), **options)
                elsewhere.append(sent)
            else:
                here.append(collect(context.policy, context.envs.get(key), share.tolist(), **options))
        first, *rest = [*reversed(here), *(wait() for wait in reversed(elsewhere))]
        return first.join(*rest)

    def _kept(self, done: Collected) -> Experience:
        """Return the frames of episodes that tell something: in groups with spread."""
        advantages = group_advantages(done.rewards.view(-1, self.episodes)).flatten()
        of_frame = advantages[done.episode]
        frames = done.frames.rows(of_frame != 0)
        return Experience(**{**vars(frames), "advantages": of_frame[of_frame != 0]})

    def _record(self, done: Collected) -> dict[str, Any]:
        """Return the fields of a `CollectionRecord`."""
        groups = done.rewards.view(-1, self.episodes)
        return {
            "episodes": int((~done.rewards.isnan()).sum()),
            "successes": int(done.rewards.nansum()),
            "steps": len(done.episode),
            "groups": int((group_advantages(groups) != 0).any(1).sum()),
            "entropy": -float(done.frames.log_probs.mean()),
        }


def _batches(frames: Experience, sizes: Sequence[int]) -> Iterator[Batch]:
    """Yield batches of frames in permutations of all, drawn from the global generator; none where there are none."""
    if not len(frames):
        return
    needed = sum(sizes)
    order = torch.cat([torch.randperm(len(frames)) for _ in range(-(-needed // len(frames)))])[:needed]
    for chosen in order.split(list(sizes)):
        yield frames.rows(chosen)
