"""Demonstrations from seeds: the expert acts without rendering; the states of successful attempts are rendered."""

import zlib
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from libero_env.demos.config import DemoConfig
from libero_env.demos.observe import StateRenderer
from libero_env.demos.read import Episode
from libero_env.demos.write import DemoWriter
from libero_env.envs.batch import BatchEnv
from libero_env.errors import PlacementError
from libero_env.expert import ActionNoise, Expert, MotionStyle, Shapes
from libero_env.expert.expert import MAX_STEPS, Attempt, run_experts
from libero_env.parallel import tell_work
from libero_env.tasks.task import NUM_INIT_STATES

MAX_ATTEMPTS = 10  # attempts at one demonstration
_ATTEMPT_SHARE = 0.5  # of the time of a demonstration, for the progress


@dataclass
class RecordingReport:
    """Outcome of a recording.

    Attributes:
        recorded: Number of demonstrations there are now.
        attempts: Number of attempts, failed ones included.
        failure_reasons: Why attempts failed, with the number of such attempts.
        error: Why some demonstrations cannot be recorded, or "".
    """

    recorded: int = 0
    attempts: int = 0
    failure_reasons: Counter[str] = field(default_factory=Counter)
    error: str = ""

    def add(self, other: "RecordingReport") -> None:
        """Add the numbers of another report to this one."""
        self.recorded += other.recorded
        self.attempts += other.attempts
        self.failure_reasons += other.failure_reasons
        self.error = self.error or other.error


class DemoRecorder:
    """Simulates attempts without rendering, and renders the states of those that succeed."""

    def __init__(self, config: DemoConfig):
        self.config, self.task = config, config.task
        self.env = BatchEnv(
            self.task,
            config.batch,
            num_threads=1,
            cameras=(),
            horizon=MAX_STEPS,
            drawing=config.drawn,
            robot=config.robot,
            backend=config.backend,
        )
        self.renderer = StateRenderer(self.task, config.render_config, robot=config.robot)
        self.shapes = Shapes(self.env.scene)

    def attempt(self, numbers: list[tuple[int, int]]) -> list[tuple[int, Attempt]]:
        """Attempt the first of the given demonstrations, as many as are simulated together.

        Args:
            numbers: Demonstration numbers, each with the number of attempts at it that failed before.

        Returns:
            Demonstration numbers, each with what happened.
        """
        placed: list[int] = []
        unplaced, experts, noises = [], [], []
        variation, name = self.config.variation, zlib.crc32(self.task.name.encode())
        style = None if variation.style else MotionStyle()  # None: the expert samples one
        for k, failures in numbers[: self.config.batch]:
            seeds = np.random.SeedSequence([self.config.seed, name, k, failures])
            start_seed, style_seed, noise_seed = seeds.spawn(3)
            try:
                self._place(len(placed), k, start_seed)
            except PlacementError as error:
                empty = np.zeros((0, 7))
                unplaced.append((k, Attempt(False, empty, empty, empty, 0, f"placement: {error}")))
                continue
            placed.append(k)
            rng = np.random.default_rng(style_seed)
            experts.append(Expert(self.task, rng, shapes=self.shapes, style=style))
            rng = np.random.default_rng(noise_seed)
            noise = ActionNoise(rng, variation.noise, variation.push_rate)
            noises.append(noise if self.config.disturb else None)
        attempts = run_experts(self.env, experts, noises, max_steps=MAX_STEPS)
        return unplaced + list(zip(placed, attempts, strict=True))

    def episode(self, attempt: Attempt, *, failed_attempts: int = 0) -> Episode:
        """Return a successful attempt with its observations.

        Args:
            attempt: What happened.
            failed_attempts: Number of attempts at the same demonstration that failed before.
        """
        shown = attempt.states[:-1] if self.config.pairing == "aligned" else attempt.states[1:]
        obs, robot_states = self.renderer.render_states(shown, attempt.fixtures)
        return Episode(
            actions=attempt.actions,
            states=attempt.states[:-1],
            robot_states=robot_states,
            obs=obs,
            expert_actions=attempt.expert_actions if self.config.disturb else None,
            fixtures=attempt.fixtures,
            attrs={
                "seed": self.config.seed,
                "failed_attempts": failed_attempts,
                "model_file": self.renderer.model_xml(attempt.fixtures),
                "retries": attempt.retries,
            },
        )

    def close(self) -> None:
        """Free the simulations and the OpenGL context."""
        self.env.close()
        self.renderer.close()

    def _place(self, slot: int, k: int, seed: np.random.SeedSequence) -> None:
        """Put one simulation at the start of demonstration k; the others stay as they are."""
        mask = np.arange(self.config.batch) == slot
        if self.config.variation.reserved:
            self.env.reset(options={"reset_mask": mask, "init_state": k % NUM_INIT_STATES})
        else:
            number = int(seed.generate_state(1)[0])
            self.env.reset(seed=[number if chosen else None for chosen in mask], options={"reset_mask": mask})


class RecorderCache:
    """Keeps the recorder of the last configuration open: the chunks of one task follow each other."""

    def __init__(self) -> None:
        self._recorder: DemoRecorder | None = None

    def recorder(self, config: DemoConfig) -> DemoRecorder:
        """Return a recorder for the configuration; the one of another configuration is closed."""
        if self._recorder is None or self._recorder.config != config:
            self.close()
            self._recorder = DemoRecorder(config)
        return self._recorder

    def close(self) -> None:
        """Close the recorder. Idempotent."""
        if self._recorder is not None:
            self._recorder.close()
            self._recorder = None


recorders = RecorderCache()  # of this process


def record_chunk(config: DemoConfig, writer: DemoWriter, numbers: list[int]) -> RecordingReport:
    """Record some demonstrations as parts of a file, with a recorder that stays open in `recorders`.

    Where the expert fails `MAX_ATTEMPTS` times on one demonstration, the report's `error` says so.

    Args:
        config: What the demonstrations depend on.
        numbers: Demonstrations to record.

    Raises:
        DemoError: A part cannot be written.
    """
    report, recorder = RecordingReport(), recorders.recorder(config)
    failures = dict.fromkeys(numbers, 0)  # of the demonstrations still to be recorded
    while failures:
        attempts = recorder.attempt(list(failures.items()))
        tell_work(_ATTEMPT_SHARE * sum(attempt.success for _, attempt in attempts))
        for k, attempt in attempts:
            report.attempts += 1
            if attempt.success:
                writer.write(k, recorder.episode(attempt, failed_attempts=failures.pop(k)))
                report.recorded += 1
                tell_work(1 - _ATTEMPT_SHARE, 1)
                continue
            report.failure_reasons[attempt.reason] += 1
            failures[k] += 1
            if failures[k] == MAX_ATTEMPTS:
                del failures[k]
                report.error = (
                    f"the expert failed {MAX_ATTEMPTS} times on demonstration {k}; "
                    f"reason of the last failure: {attempt.reason}"
                )
    return report
