"""Tuning chooses by success on what was learned, goes on where it was stopped, and writes what a run then reads."""

import json
import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from libero_cli.main import main
from lifelong import algorithms
from lifelong.composition import compose_run, swept
from lifelong.policies.base import Policy
from lifelong.settings import BenchmarkSettings, Configuration, plain_data
from lifelong.training.settings import FitSettings
from lifelong.tuning import trials
from lifelong.tuning.frontier import Frontier, Measured, Outcome, render
from lifelong.tuning.trials import StreamData, Trial, measure, scaled
from tests.harness.configs import CONFIGS, composed
from tests.harness.runs import TINY, make_windows

TUNED = {
    name: kind
    for name in algorithms.__all__
    if isinstance(kind := getattr(algorithms, name), type) and getattr(kind, "tuned", None)
}
assert TUNED
STREAM = BenchmarkSettings("libero_90", tasks=[61, 62]).sequence()
FAST = ("--steps", "2", "--starts", "2", "--stream", "61,62", "--beside")
TRAINED = [word for word in TINY if not word.startswith(("benchmark", "eval", "seed"))]
HEAD = "policy/head=deterministic_small"
WORDS = [*TRAINED, HEAD, "algo=ewc", "algo.estimator.windows=2", "train.batch_size=4"]


def outcome(label: str, *finals: tuple[float, ...]) -> Outcome:
    """One value's success on each task, in several trials."""
    return Outcome(label, {"algo.strength": float(label)}, tuple(Measured([*final]) for final in finals))


# --- the choice


def test_the_choice_has_the_largest_success_on_all_tasks() -> None:
    finals = ((0.1, 0.1, 1.0), (0.5, 0.2, 0.9), (0.6, 0.3, 0.1))
    loose, right, stiff = (outcome(str(number), final) for number, final in enumerate(finals, 1))
    frontier = Frontier((loose, right, stiff))
    assert frontier.chosen is right and not frontier.at_edge() and frontier.equals() == (right,)
    assert right.kept.value == pytest.approx(0.35) and right.learned.value == 0.9
    assert right.score.value == pytest.approx(1.6 / 3), "tasks count alike"
    assert Frontier((right, stiff)).at_edge() and not Frontier((right,)).at_edge()
    again = outcome("4", (0.2, 0.5, 0.9))
    assert Frontier((loose, right, again)).chosen is right, "the first of equal ones"
    assert Frontier((loose, right, again)).equals() == (right, again)


def test_spread_is_over_trials() -> None:
    hard = outcome("1", (0.0, 1.0), (0.5, 1.0))
    assert (hard.kept.low, hard.kept.value, hard.kept.high) == (0.0, 0.25, 0.5)
    assert str(hard.kept) == "25% [0%, 50%]" and str(hard.learned) == "100%"


def test_the_frontier_is_what_nothing_else_is_better_than_in_both() -> None:
    one, two, worse = outcome("1", (0.3, 0.9)), outcome("2", (0.5, 0.7)), outcome("3", (0.4, 0.6))
    frontier = Frontier((one, two, worse), (outcome("9", (1.0, 1.0)),))
    assert [frontier.is_efficient(o) for o in frontier.outcomes] == [True, True, False]
    table = render(frontier, "3").splitlines()
    assert "default" in table[4] and "frontier" not in table[4] and "**chosen**" in table[2]
    assert len(table) == 6 and len({len(line) for line in table}) == 1


# --- the measurement


def test_steps_are_scaled_with_their_warm_up() -> None:
    short = scaled(FitSettings(epochs=8, steps_per_epoch=100, warmup_steps=50), 160)
    assert (short.epochs, short.steps_per_epoch, short.warmup_steps) == (8, 20, 10)
    few = scaled(FitSettings(epochs=50), 5)
    assert (few.epochs, few.steps_per_epoch) == (5, 1)


@pytest.mark.parametrize("name", TUNED)
def test_settings_that_are_tuned_exist_and_do_not_act_before_the_end_of_the_first_task(name: str) -> None:
    kind = TUNED[name]
    plain = plain_data(composed(f"algo={kind.__module__.rpartition('.')[2]}"))
    for key, values in kind.tuned.items():
        for value in values:
            config = {**plain, "algo": {**plain["algo"], key: value}}
            assert getattr(Configuration(config).build("algo"), key) == value
        assert sorted(values) == list(values)
    if kind.plain_start:
        untouched = Configuration(plain).build("algo").state_dict()
        assert not any(isinstance(v, torch.Tensor) for v in _leaves(untouched)), "before the first end"


def _leaves(tree):
    return [leaf for v in tree.values() for leaf in _leaves(v)] if isinstance(tree, dict) else [tree]


def random_stream(*words: str) -> tuple[dict[str, Any], StreamData]:
    """Return a configuration, and a stream of random frames for it."""
    config = plain_data(composed(*TINY, *words))
    spec = Configuration(config).build("data").spec(384)
    return config, StreamData(spec, tuple(make_windows(task, spec) for task in range(2)))


@pytest.fixture
def fake_streams(monkeypatch):
    """Streams of random frames, of which half of the rollouts succeed; return the list of those that were opened."""
    opened = []

    def open_stream(config, tasks):
        checked = Configuration(config)
        spec = checked.build("data").spec(384)
        windows = [make_windows(task, spec) for task in range(len(tasks))]
        opened.append(len(tasks))
        return StreamData(spec, tuple(windows))

    trials._open.cache_clear()
    monkeypatch.setattr(trials, "open_stream", open_stream)
    monkeypatch.setattr(trials, "_success", lambda *_: 0.5)
    yield opened
    trials._open.cache_clear()


def tune(*words: str) -> int:
    return main(["tune", *words])


def test_a_sweep_is_measured_once_and_its_choice_is_what_a_run_reads(tmp_path, fake_streams, capsys) -> None:
    out, own = tmp_path / "out", tmp_path / "own"
    words = [*WORDS, "algo.strength=10,1e3", *FAST, "--out", str(out), "--write", str(own)]
    assert tune(*words) == 0
    said = (told := capsys.readouterr()).out
    assert "2 starts of each task" in said and " s of rollouts)" in said, "what it costs"
    assert "| 1000 " in said and "| sequential " not in said and "**chosen**" in said
    record = json.loads((out / "ewc-deterministic_small-strength.json").read_text())
    assert [row["label"] for row in record["values"]] == ["10", "1000"]
    assert record["command"] == shlex.join(["libero", "tune", *WORDS, "algo.strength=10,1e3", *FAST])
    assert (out / "ewc-deterministic_small-strength.png").stat().st_size > 1000
    tuned = own / "tuned" / "deterministic_small" / "ewc.yaml"
    assert yaml.safe_load(tuned.read_text()) == {"strength": record["chosen"]["algo.strength"]}
    config, _ = compose_run(["algo=ewc", said.split()[-1]], own)
    assert config.algo.strength == record["chosen"]["algo.strength"]

    assert "10, 1000 succeed equally" in told.err and "--starts" in told.err
    assert fake_streams == [2]
    assert tune(*words) == 0, "everything is read back"
    assert fake_streams == [2]
    assert json.loads((out / "ewc-deterministic_small-strength.json").read_text()) == record

    other = [word for word in words if not word.startswith("algo=ewc") and "estimator" not in word]
    words = ["algo=mas", *other]  # of which the package has a tuned value for this head
    assert tune(*words) == 0
    choice = capsys.readouterr().out.split()[-1]
    assert choice == "tuned@algo=deterministic_small/mas_own"
    assert compose_run(["algo=mas", choice], own)[0].algo.strength in (10, 1000)
    mixture = own / "tuned" / "gmm_small" / "ewc.yaml"  # beside the package's, of the estimator
    mixture.parent.mkdir()
    mixture.write_text("estimator: {strength: 99}\n")
    chosen, _ = compose_run(["algo=ewc", "tuned@algo=gmm_small/ewc"], own)
    assert chosen.algo.estimator.strength == 99


def test_a_sweep_that_is_stopped_goes_on_to_the_same_result(tmp_path, fake_streams, monkeypatch) -> None:
    words = [*WORDS, "algo.strength=10,1e3", *FAST, "--out"]
    assert tune(*words, str(tmp_path / "whole")) == 0
    trained, train = [], trials._train

    def stopped(algorithm, policy, task, windows, settings, seed):
        if len(trained) == 3:  # in the second task of the first value
            raise KeyboardInterrupt
        trained.append(task)
        train(algorithm, policy, task, windows, settings, seed)

    monkeypatch.setattr(trials, "_train", stopped)
    while tune(*words, str(tmp_path / "parts")):
        assert len(trained) <= 3
        trained.pop()
    assert _weights(tmp_path / "parts") == _weights(tmp_path / "whole")


def _weights(out: Path) -> dict[str, list[str]]:
    """Return the digests of the policies at the end, of each value."""
    (path,) = out.glob("*.json")
    return {
        row["label"]: [one["weights"] for one in row["trials"]]
        for row in json.loads(path.read_text())["values"]
    }


def test_the_first_task_is_learned_once_for_all_values_to_the_same_bits(
    tmp_path, fake_streams, monkeypatch
) -> None:
    words = [*WORDS, "algo=si", "~algo.estimator", "algo.strength=0.1,1", *FAST, "--out"]
    words = [word for word in words if "estimator" not in word and word != "algo=ewc"]
    trained, train = [], trials._train
    monkeypatch.setattr(
        trials, "_train", lambda a, p, task, *rest: (trained.append(task), train(a, p, task, *rest))
    )
    assert tune(*words, str(tmp_path / "shared")) == 0
    assert trained == [0, 1, 1], "SI, which collects its path on the first task, goes on from there"
    digests = iter(range(100))
    monkeypatch.setattr(trials.Trial, "start_key", lambda trial, algorithm: str(next(digests)))
    assert tune(*words, str(tmp_path / "apart")) == 0
    assert trained[3:] == [0, 1] * 2
    assert _weights(tmp_path / "shared") == _weights(tmp_path / "apart")


def test_starts_are_not_shared_between_streams_by_whose_later_tasks_the_first_is_normalised() -> None:
    config, tasks = plain_data(composed("algo=ewc", "data.statistics=stream")), STREAM
    algorithm = Configuration(config).build("algo")
    one, other = (Trial(config, stream, 1, 10) for stream in (tasks, tasks[:1]))
    assert one.start_key(algorithm) != other.start_key(algorithm)


@pytest.mark.parametrize("algo", ["sequential", "single_task"])  # which goes back to its first weights
@pytest.mark.parametrize(("kind", "counted"), [
    ("first", [[0], [0]]), ("latest", [[0], [1]]), ("seen", [[0], [0, 1]]), ("stream", [[0, 1], [0, 1]])
])  # fmt: skip
def test_tasks_are_met_and_readings_normalised_as_in_a_run(
    algo, kind, counted, tmp_path, monkeypatch
) -> None:
    config, data = random_stream(HEAD, "train.batch_size=4", f"data.statistics={kind}", f"algo={algo}")
    spec, windows = data.spec, data.training
    found, met, fit = [], [], trials.fit

    def watched(policy, *rest, **settings):
        scaling = policy.proprio.scaling
        found.append(torch.cat([getattr(scaling, f"centre_{name}") for name in spec.proprio]))
        fit(policy, *rest, **settings)

    monkeypatch.setattr(trials, "fit", watched)
    monkeypatch.setattr(trials, "_success", lambda *_: 0.5)
    monkeypatch.setattr(Policy, "meet_task", lambda policy, dataset, text: met.append(text))
    measure(Trial(config, STREAM, 1, 2, 1), lambda: data, tmp_path)
    readings = [torch.cat([w.proprio[name] for name in spec.proprio], 1) for w in windows]
    for centre, tasks in zip(found, counted, strict=True):
        torch.testing.assert_close(centre, torch.cat([readings[k] for k in tasks]).mean(0))
    assert list(dict.fromkeys(met)) == [task.language for task in STREAM]


def test_statistics_adapt_before_the_first_phase_alone_as_in_a_run(tmp_path, monkeypatch) -> None:
    (config, data), found = random_stream("algo=packnet", "train.statistics_first=true"), []
    monkeypatch.setattr(trials, "fit", lambda *_, settings, **rest: found.append(settings.statistics_first))
    monkeypatch.setattr(trials, "_success", lambda *_: 0.5)
    measure(Trial(config, STREAM, 1, 2, 1), lambda: data, tmp_path)
    assert found == [True, False, True, False]


@pytest.mark.sim
def test_each_task_is_rolled_out_at_the_end_as_in_a_run(tmp_path, monkeypatch) -> None:
    """By what acts on it: of single_task, the first policy on the first task."""
    words = ("benchmark=libero_90", "eval.horizon=3", "eval.settle_steps=1", "eval.sim_threads=1")
    config, data = random_stream(*words, "algo=single_task", "train.batch_size=4")
    seen, rollout = [], trials.rollout

    def watched(policy, env, init_states, **rest):
        done = rollout(policy, env, init_states, **rest)
        first = torch.cat([p.detach().flatten() for p in policy.parameters()])
        starts, lengths = ([getattr(e, name) for e in done.episodes] for name in ("init_state", "length"))
        seen.append((env.task, starts, lengths, first))
        return done

    monkeypatch.setattr(trials, "rollout", watched)
    trial = Trial(config, STREAM, 1, 2, 2)
    found = measure(trial, lambda: data, tmp_path)
    assert [one[:3] for one in seen] == [(task, [0, 1], [3, 3]) for task in STREAM]
    assert not torch.equal(seen[0][3], seen[1][3]) and found.success == [0.0, 0.0]
    assert measure(trial, lambda: data, tmp_path) == found and len(seen) == 2, "it is read back"
    longer = Trial({**config, "eval": {**config["eval"], "horizon": 4}}, STREAM, 1, 2, 2)
    assert len({trial.key(), longer.key(), Trial(config, STREAM, 1, 2, 3).key()}) == 3


def test_rollouts_are_as_long_as_the_suite_of_the_streams_needs_and_more_steps_are_advised_where_none_succeeds(
    tmp_path, fake_streams, monkeypatch, capsys
) -> None:
    found = []

    def failed(trial, *_):
        found.append(trial.config["eval"]["horizon"])
        return 0.0

    monkeypatch.setattr(trials, "_success", failed)
    words = ["preset=laptop", *(w for w in WORDS if not w.startswith("preset"))]
    assert tune(*words, "algo.strength=10,20", *FAST, "--out", str(tmp_path)) == 0
    assert set(found) == {400}
    assert "10, 20 succeed equally (0%): give more --steps than 2 a task" in capsys.readouterr().err


# --- what is typed wrongly


@pytest.mark.parametrize("changed", ["source_digest", "installed_versions"])
def test_trials_of_another_source_or_expert_and_of_other_models_are_measured_again(
    changed, monkeypatch
) -> None:
    trial = Trial(plain_data(composed("algo=ewc")), (), 1, 10)
    algorithm = Configuration(trial.config).build("algo")
    before = trial.key(), trial.start_key(algorithm)
    monkeypatch.setattr(trials, changed, lambda: "0" * 12)
    assert trial.key() != before[0] and trial.start_key(algorithm) != before[1]


@pytest.mark.parametrize(
    "words", ["data.files=[FOLDER/own.hdf5]", "data.folder=FOLDER", "data.files=['rlds:FOLDER']"]
)
def test_trials_of_demonstrations_that_were_replaced_are_measured_again(words, tmp_path) -> None:
    config, keys = plain_data(composed("algo=ewc", words.replace("FOLDER", str(tmp_path)))), set()
    for content in ("", "recorded", "recorded again"):
        (tmp_path / "own.hdf5").write_text(content)
        keys.add(Trial(config, (), 1, 10).key())
    assert len(keys) == 3


def test_values_that_change_nothing_are_named(capsys, tmp_path, fake_streams) -> None:
    assert tune(*WORDS, "data.memory=host,auto", *FAST, "--out", str(tmp_path)) == 0
    assert "all values leave the same weights: data.memory has no effect" in capsys.readouterr().err
    assert tune(*WORDS, "train.lr=1e-3,2e-3", *FAST, "--out", str(tmp_path)) == 0
    assert "same weights" not in capsys.readouterr().err


def test_a_preset_prevails_over_the_tuned_value_of_a_head(tmp_path) -> None:
    (tmp_path / "preset").mkdir()
    text = "# @package _global_\ndefaults: [laptop]\nalgo: {strength: 5.0}\n"
    (tmp_path / "preset" / "mine.yaml").write_text(text)
    assert compose_run(["algo=lwf"])[0].algo.strength == 1.0  # that of the mixture
    assert compose_run(["algo=lwf", "preset=mine"], tmp_path)[0].algo.strength == 5.0


def test_lists_of_values_are_found_and_others_are_left() -> None:
    found = swept(["algo=ewc", "algo.strength=1,1e3", "data.proprio=[a,b]"])
    assert found == {"algo.strength": ["1", "1000.0"]}


@pytest.mark.parametrize(("words", "told"), [
    (["algo=dmpel"], "suggests no values"),
    (["algo=er", "compat=libero"], "suggests no values"),
    (["algo=ewc", "algo.strenght=1,2"], "Did you mean 'algo.strength'"),
    (["algo=ewcc"], "Did you mean 'ewc'"),
    (["algo=ewc", "algo.strength=-1,2"], "algo.strength"),
    (["algo=ewc", "--stream", "61"], "one task"),
    (["algo=ewc", "--stream", "61,990"], "unknown task"),
    (["algo=ewc", "--suite", "own", "--stream", "0,1"], "unknown suite 'own'"),
    (["algo=multitask", "train.lr=1e-3,2e-3"], "several tasks together"),
    (["algo=ewc", "algo.strength=[1"], "["),
    (["algo=ewc", "algo.strength=interval(1,2)"], "algo.strength lists no values to try"),
])  # fmt: skip
def test_mistakes_take_one_line(words, told, capsys, tmp_path, fake_streams) -> None:
    assert tune(*TRAINED, *words, "--steps", "1", "--beside", "--out", str(tmp_path)) != 0
    error = capsys.readouterr().err
    assert told in error and len(error.strip().splitlines()) == 1


@pytest.mark.parametrize(("words", "key"), [
    (["init_from=/no/such/run"], "init_from"),
    (["pretrain=libero_90"], "pretrain.suite"),
    (["stream.demos_later=5"], "stream.demos_later"),
    (["stream.blur=0.5"], "stream.blur"),
    (["stream=pretrained6"], "stream.base_tasks"),
    (["stream.perturb={light:1}"], "stream.perturb"),
    (["data.perturb='light=1'"], "data.perturb"),
    (["benchmark.group_size=2"], "benchmark.group_size"),
    (["device=cuda"], "device"),
    (["tracker=wandb"], "tracker"),
    (["eval.episodes=1,2"], "eval.episodes"),
    (["seed=3"], "seed"),
    (["train.steps_per_epoch=10"], "train.steps_per_epoch"),
    (["benchmark=libero_goal"], "benchmark"),
])  # fmt: skip
def test_what_no_trial_obeys_is_refused_by_name(words, key, capsys, tmp_path, fake_streams) -> None:
    assert tune(*WORDS, "threads=1", "progress=false", *words, *FAST, "--out", str(tmp_path)) != 0
    error = capsys.readouterr().err
    assert f"{key} has no effect in libero tune; leave it out" in error
    assert len(error.strip().splitlines()) == 1 and not fake_streams


def test_a_key_outside_of_the_algorithm_is_not_written_and_says_so_before_it_is_measured(
    capsys, tmp_path, fake_streams
) -> None:
    words = ("train.lr=1e-3,2e-3", *FAST, "--out", str(tmp_path), "--write", str(tmp_path))
    assert tune(*WORDS, *words) == 2
    assert "--write keeps settings of the algorithm, and train.lr is none" in capsys.readouterr().err
    assert not fake_streams


def test_algorithms_are_compared_with_themselves(capsys, tmp_path, fake_streams) -> None:
    """Values of the same label: `algo=er` beside er, 1 and 1.0."""
    words = [word for word in WORDS if not word.startswith("algo")]
    assert tune(*words, "algo=er,lwf", *FAST, "er", "--out", str(tmp_path)) == 0
    said = capsys.readouterr().out
    assert said.count("\n| er ") == 2 and re.search("chosen: algo=(er|lwf)\n", said)


# --- what is shipped

SHIPPED = sorted((CONFIGS / "tuned").glob("*/*.yaml"))


def _chosen(path: Path, words: Sequence[str]) -> dict[str, Any]:
    algo = plain_data(compose_run(words)[0])["algo"]
    return algo["estimator"] if path.stem.endswith("_sample") else algo


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_chosen_values_are_used_with_their_head_and_not_with_the_original(path) -> None:
    head, algo = path.parent.name, path.stem.removesuffix("_sample")
    values = yaml.safe_load(path.read_text())
    used = _chosen(path, [f"algo={algo}", f"policy/head={head}"])
    assert {key: used[key] for key in values} == values
    source = path.read_text()
    assert "libero tune" in source or "Derived, not measured" in source
    if algo in ("ewc", "er", "agem", "packnet"):  # whose published choices compat=libero composes
        original = _chosen(path, ["compat=libero", f"algo={algo}", f"policy/head={head}"])
        plain = _chosen(path, ["compat=libero", "preset=paper", f"algo={algo}"])
        assert {key: original[key] for key in values} == {key: plain[key] for key in values}
