"""Inference that takes time: words of a clock, what is executed while an answer is awaited, what is recorded."""

import json
import math
import os
from itertools import islice
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from libero_cli.main import main
from libero_env.errors import LiberoError
from libero_eval.protocols.clock import Clock, ClockedActor, Latency
from libero_eval.protocols.files import load_protocol
from lifelong.data.fake import fake_observation
from lifelong.errors import ConfigError, ProtocolError
from lifelong.evaluation.actors import Hears, PolicyActor
from lifelong.nn import FlowHead
from lifelong.nn.flow import prefix_weights
from lifelong.policies.bc_mlp import BCMLP
from lifelong.seeding import generator
from lifelong.types import PolicySpec, Unfinished
from tests.harness.evaluations import write_policy

STILL = [0, 0, 0, 0, 0, 0, -1]


class Counting:
    """Answers with chunks whose actions say of which step's observation they are, and which of the chunk."""

    action_dim, views, observes = 7, (), "asked"

    def __init__(self, length: int, replan: int | None = None):
        self.length, self.replan, self.asked = length, replan, []

    def reset(self, num_envs):
        self.asked = []

    def plan(self, obs, rows, before=None):
        self.asked.append((int(obs["t"]), list(rows), before))
        chunk = np.zeros((self.length, 7))
        chunk[:, 0], chunk[:, 1], chunk[:, 6] = obs["t"], np.arange(self.length), 0.5
        return [chunk + [0, 0, i, 0, 0, 0, 0] for i in rows]


def run(words: str, length: int, replan: int | None = None, steps: int = 12, count: int = 1, seeds=()):
    """Return the actor, its planner and the actions of each step, (steps, count, 7)."""
    planner = Counting(length, replan)
    actor = ClockedActor(planner, Clock.read(words), seeds, still=STILL)
    actor.reset(count)
    return actor, planner, np.stack([actor.act({"t": t}) for t in range(steps)])


@pytest.mark.parametrize(("text", "stored"), [
    ("latency=120ms,merge=replace", "latency=120ms"),
    ("wait=hold, latency=3steps", "latency=3steps,wait=hold"),
    ("every=8,merge=rtc", "latency=0ms,merge=rtc,every=8"),
    ("merge=ensemble,m=0.1,latency=1e2ms", "latency=100ms,merge=ensemble,m=0.1"),
    ("latency=lognormal:0.12/0.4s", "latency=lognormal:120/0.4ms"),
    ("latency=40/45.5/210ms", "latency=40/45.5/210ms"),
])  # fmt: skip
def test_words_of_a_clock(text, stored):
    assert str(Clock.read(text)) == stored and str(Clock.read(stored)) == stored
    assert load_protocol("openpi").changed({"action.clock": stored}).action.clock == stored


@pytest.mark.parametrize(("text", "told"), [
    ("latency=-50ms", "'-50' is not a number from 0"),
    ("latency=50", "latency=50: expected 120ms"),
    ("latency=normal:1/2/3ms", "expected 120ms"),
    ("latency=uniform:9/2ms", "second number is the largest"),
    ("latency=trace:nowhere.txt", "trace:nowhere.txt: No such file"),
    ("latency=trace:/dev/zero", "it is a folder, a pipe or a device"),
    ("latency=trace:empty.txt", "expected a line with the unit .*got '' and 0"),
    ("latency=trace:bare.txt", "expected a line with the unit .*got '45' and 1"),
    ("latency=trace:words.txt", "words.txt, line 3: 'soon' is not a number"),
    ("latency=trace:bytes.txt", "not text"),
    ("merge=average", "clock.merge is 'average'; expected .*'rtc'"),
    ("every=0", "every.*1"),
    ("m=0.1", "m is of merge=ensemble"),
    ("merge=rtc,wait=hold", "merge=rtc executes the rest .*wait=rest"),
    ("wait=hold,wait=rest", "wait is named twice"),
    ("latencies=5ms", "Did you mean 'latency'"),
])  # fmt: skip
def test_words_that_mean_nothing_take_one_line(text, told, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    contents = {"empty": b"", "bare": b"45\n50", "words": b"ms\n45\nsoon", "bytes": b"\xff"}
    for name, content in contents.items():
        (tmp_path / f"{name}.txt").write_bytes(content)
    with pytest.raises(LiberoError, match=told) as caught:
        Clock.read(text)
    assert "\n" not in str(caught.value)


def test_a_protocol_keeps_a_clock_in_the_words_that_are_stored(tmp_path):
    plain = load_protocol("openpi")
    with pytest.raises(ProtocolError, match="in the words that are stored it is 'latency=100ms'"):
        plain.changed({"action.clock": "latency=0.1s"})
    os.mkfifo(tmp_path / "pipe")  # which nobody opens: a result or a protocol may be somebody else's
    with pytest.raises(ProtocolError, match="a protocol has the latencies, and only --clock names a file"):
        plain.changed({"action.clock": f"latency=trace:{tmp_path / 'pipe'}"})
    assert plain.digest != plain.changed({"action.clock": "latency=0ms"}).digest


def test_latencies_are_rounded_up_to_control_steps(tmp_path):
    def steps(text, hz=20, count=1, seed=(0,)):
        return list(islice(Latency.read(text).draws(hz, seed), count))

    assert [steps(f"{ms}ms")[0] for ms in (0, 1, 50, 51, 100, 150, 400)] == [0, 1, 1, 2, 2, 3, 8]
    assert steps("0.12s", hz=10) == [2] and steps("3steps", hz=10) == [3] and steps("2.1steps") == [3]
    (tmp_path / "trace.txt").write_text("s\n0.04\n0.06\n0.3\n")
    measured = Latency.read(f"trace:{tmp_path / 'trace.txt'}")
    assert str(measured) == "40/60/300ms", "a result needs no file"
    begins = set()
    for seed in range(20):
        found = list(islice(measured.draws(20, (seed,)), 7))
        place = [1, 2, 6].index(found[0])
        assert found == [[1, 2, 6][(place + i) % 3] for i in range(7)]
        begins.add(place)
    assert begins == {0, 1, 2}
    draws = steps("normal:120/30ms", count=2000)
    assert draws == steps("normal:120/30ms", count=2000) != steps("normal:120/30ms", count=2000, seed=(1,))
    assert np.mean(draws) == pytest.approx(2.4 + 0.5, abs=0.06), "the mean, and half a step of rounding up"
    assert min(steps("normal:1/100ms", count=100)) == 0
    assert np.median(steps("lognormal:100/0.5ms", hz=500, count=2000)) == pytest.approx(50, abs=2)
    assert max(steps("lognormal:100/1e9ms", count=100)) > 0, "no draw is infinite"
    assert set(steps("uniform:60/140ms", count=100)) == {2, 3}


WAITS, HOLDS = (0.0, 0.0, -1.0), (0.0, 0.0, 0.5)  # before it has acted, and later: the gripper stays as it is


@pytest.mark.parametrize(("words", "length", "replan", "wanted"), [
    # two steps go by: the actions 0 and 1 of a chunk are stale
    ("latency=100ms", 6, 3,
     [WAITS, WAITS, (0, 0), (0, 1), (0, 2), (0, 3), (0, 4), (5, 2), (5, 3), (5, 4), (8, 2), (8, 3)]),
    # it stands still meanwhile, so nothing is stale
    ("latency=100ms,wait=hold", 6, 3,
     [WAITS, WAITS, (0, 0), (0, 1), (0, 2), HOLDS, HOLDS, (5, 0), (5, 1), (5, 2), HOLDS, HOLDS]),
    ("latency=100ms,wait=repeat", 6, 3,
     [WAITS, WAITS, (0, 0), (0, 1), (0, 2), (0, 2), (0, 2), (5, 0), (5, 1), (5, 2), (5, 2), (5, 2)]),
    # the rest of the chunk is shorter than the latency: one action is stale, three steps are held
    ("latency=4steps", 4, 3,
     [WAITS, WAITS, WAITS, WAITS, (0, 0), (0, 1), (0, 2), (0, 3), HOLDS, HOLDS, HOLDS, (7, 1)]),
    # as soon as the last answer is there
    ("latency=100ms,every=1", 6, 3,
     [WAITS, WAITS, (0, 0), (0, 1), (0, 2), (3, 2), (3, 3), (5, 2), (5, 3), (7, 2), (7, 3), (9, 2)]),
    # all of the chunk, which is the default without a number
    ("latency=50ms", 3, None,
     [WAITS, (0, 0), (0, 1), (0, 2), HOLDS, (4, 0), (4, 1), (4, 2), HOLDS, (8, 0), (8, 1), (8, 2)]),
    # single actions are late, and none is lost
    ("latency=100ms", 1, 1,
     [WAITS, WAITS, (0, 0), HOLDS, HOLDS, (3, 0), HOLDS, HOLDS, (6, 0), HOLDS, HOLDS, (9, 0)]),
    ("latency=0ms", 5, 2,
     [(0, 0), (0, 1), (2, 0), (2, 1), (4, 0), (4, 1), (6, 0), (6, 1), (8, 0), (8, 1), (10, 0), (10, 1)]),
])  # fmt: skip
def test_what_is_executed_while_an_answer_is_awaited(words, length, replan, wanted):
    found = run(words, length, replan)[2][:, 0]
    shown = [(*row[:2], 0.5) if len(row) == 2 else row for row in wanted]
    np.testing.assert_array_equal(found[:, [0, 1, 6]], shown)


def test_what_is_counted():
    assert run("latency=100ms", 6, 3)[0].timing == [(4, 3, 2)], "the fourth answer is on its way"
    assert run("latency=1s", 5, 2)[0].timing == [(1, 0, 12)]
    assert run("latency=0ms", 5, 2)[0].timing == [(6, 6, 0)]
    actor, planner, _ = run("latency=100ms", 6, 3, steps=8, count=2)
    assert [(t, rows) for t, rows, _ in planner.asked] == [(0, [0, 1]), (5, [0, 1])]
    actor.note(np.array([True, False]), np.zeros(2, bool))
    assert actor.sees_next
    actions = actor.act({"t": 8})
    assert planner.asked[-1][:2] == (8, [1]) and not actions[0].any() and not actor.sees_next
    assert actor.timing == [(2, 2, 2), (3, 2, 2)], "time of an episode that is over does not go on"
    assert ClockedActor(Counting(5)).timing == [], "nothing is recorded without a clock"


def test_absolute_actions_stay_where_nothing_moves():
    actor = ClockedActor(Counting(2), Clock.read("latency=50ms"), still=STILL, relative=False)
    actor.reset(1)
    found = [actor.act({"t": t})[0] for t in range(4)]
    np.testing.assert_array_equal(found[3], found[2]), "the last pose is the goal"
    assert found[2][1] == 1
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    actor.watch(SimpleNamespace(views=[SimpleNamespace(eef_pos=np.array([1.0, 2.0, 3.0]), eef_mat=turned)]))
    actor.reset(1)
    np.testing.assert_allclose(actor.act({"t": 0})[0], [1, 2, 3, 0, 0, np.pi / 2, -1])


def test_ensembling_averages_all_chunks_that_are_there():
    _, _, found = run("merge=ensemble,m=0.5", 3, 3, steps=6)
    weights = np.exp([0, -0.5, -1.0])
    for t, (action,) in enumerate(found):
        chunks = np.arange(max(0, t - 2), t + 1)  # the oldest first
        of = weights[: len(chunks)] / weights[: len(chunks)].sum()
        assert action[0] == pytest.approx(chunks @ of) and action[1] == pytest.approx((t - chunks) @ of)
    late = run("latency=50ms,merge=ensemble", 3, 3, steps=6)[2][:, 0, :2]
    np.testing.assert_array_equal(late[:3], [(0, 0), (0, 0), (0, 1)])  # 2: that of 0 alone
    of = np.exp([0, -0.01])
    np.testing.assert_allclose(late[4], [np.array([2, 3]) @ of / of.sum(), np.array([2, 1]) @ of / of.sum()])


def test_a_policy_that_inpaints_is_told_what_is_left():
    _, planner, found = run("latency=2steps,merge=rtc", 6, 3)
    assert found[:, 0, :2].tolist()[2:9] == [[0, 0], [0, 1], [0, 2], [0, 3], [0, 4], [5, 2], [5, 3]]
    (_, _, first), (step, _, then), *_ = planner.asked
    assert first[0][0].shape == (0, 7) and first[0][1] == 0
    assert step == 5 and then[0][0][:, 1].tolist() == [3, 4, 5] and then[0][1] == 2


@pytest.mark.parametrize(("words", "length", "told"), [
    ("merge=ensemble", 1, "merge=ensemble merges chunks, and the policy answers with single actions"),
    ("every=5", 4, "every=5, and the policy's answers have 4 actions"),
])  # fmt: skip
def test_answers_that_cannot_be_merged_are_refused(words, length, told):
    with pytest.raises(ConfigError, match=told):
        run(words, length)


def test_episodes_have_clocks_of_their_own():
    words, seeds = "latency=uniform:0/400ms,every=2", [(0, 4, 3, state) for state in range(4)]
    _, planner, together = run(words, 8, count=4, seeds=seeds, steps=40)
    assert len({tuple(rows) for _, rows, _ in planner.asked}) > 3, "they ask at different times"
    for i, seed in enumerate(seeds):
        alone = run(words, 8, seeds=[seed], steps=40)[2][:, 0]
        np.testing.assert_array_equal(np.delete(together[:, i], 2, 1), np.delete(alone, 2, 1))


def small_policy(stochastic: bool, **head) -> BCMLP:
    torch.manual_seed(0)
    spec = PolicySpec(image_size=(32, 32), language_dim=8, seq_len=8)
    flow = lambda **sizes: FlowHead(hidden=16, layers=1, steps=4, **head, **sizes)  # noqa: E731
    return BCMLP(spec=spec, head=flow, stochastic=stochastic).eval()


def acting(policy, frames, clock=None, count=3, states=range(3)):
    """Return the actions of a policy in frames, (steps, count, 7); None: by `act`, without an actor on a clock."""
    draws = [generator(0, state) for state in states]
    actor = PolicyActor(policy, torch.zeros(8), torch.device("cpu"), "fp32", draws)
    if clock is not None:
        actor = ClockedActor(actor, clock, [(0, state) for state in states])
    actor.reset(count)
    return np.stack([actor.act(frame) for frame in frames])


@pytest.fixture(scope="module")
def frames():
    spec, draws = PolicySpec(image_size=(32, 32), language_dim=8), torch.Generator().manual_seed(0)
    found = []
    for _ in range(12):
        seen = fake_observation(spec, 3, draws, steps=1)
        views = {view: seen.images[:, 0, i].numpy() for i, view in enumerate(spec.views)}
        found.append(views | {name: value[:, 0].numpy() for name, value in seen.proprio.items()})
    return found


@pytest.mark.parametrize("stochastic", [False, True])
def test_without_latency_a_run_acts_as_ever_to_the_bit(frames, stochastic):
    policy = small_policy(stochastic, chunk=5, execute=3)
    plain, clocked = acting(policy, frames), acting(policy, frames, Clock())
    assert plain.tobytes() == clocked.tobytes() and len(np.unique(plain[:, 0], axis=0)) == len(frames)


def test_an_episode_of_a_run_does_not_depend_on_when_others_ask(frames):
    policy, late = small_policy(True, chunk=5, execute=3), Clock.read("latency=uniform:0/300ms")
    found = acting(policy, frames, late)
    others = acting(policy, frames, late, states=(0, 7, 8))  # other clocks and draws beside it
    assert found[:, 0].tobytes() == others[:, 0].tobytes() != found[:, 1].tobytes()


def test_the_flow_policy_continues_its_chunk(frames):
    policy = small_policy(True, chunk=6, execute=2)
    found = {
        merge: acting(policy, frames, Clock.read(f"latency=100ms,merge={merge}"))
        for merge in ("replace", "rtc")
    }
    np.testing.assert_array_equal(found["replace"][:5], found["rtc"][:5])  # the first chunk continues none
    assert np.abs(found["replace"][5:] - found["rtc"][5:]).max() > 0.01

    head = policy.head
    params = head(torch.randn(2, head.velocity.enter.in_features - 6 * 8 - 12))
    draws = lambda: [generator(i) for i in range(2)]  # noqa: E731
    free = head.plan(params, draws())
    empty = {i: Unfinished(torch.zeros(0, 7), 0) for i in range(2)}
    np.testing.assert_array_equal(head.plan(params, draws(), empty).detach(), free.detach())
    left = free[0, 1:].detach() + 0.5
    bound = head.plan(params, draws(), {0: Unfinished(left, 2)}).detach()
    assert (bound[0, :2] - left[:2]).abs().max() < 0.3 * (free[0, :2] - left[:2]).abs().max()
    np.testing.assert_array_equal(bound[1], free[1].detach())  # it has nothing left
    fields = [(bound[0, :5] - left).abs().mean(-1)[i].item() for i in (0, 4)]
    assert fields[0] < fields[1], "what is executed binds more than what comes later"


def test_the_guidance_is_that_of_the_published_equations():
    """One step of the integration by an explicit Jacobian."""
    torch.manual_seed(0)
    head = FlowHead(in_dim=3, action_dim=2, chunk=3, execute=1, hidden=8, layers=1, steps=2).double()
    params = {"latent": torch.randn(1, 3).double(), "slots": torch.ones(1, 3).double()}
    head.velocity.forward = lambda x, time, latent, slots: torch.tanh(x.flip(1)) * (1 + time[..., None, None])
    left, weight = torch.randn(2, 2).double(), torch.tensor([1.0, 0.5 * math.expm1(0.5) / math.expm1(1), 0.0])
    np.testing.assert_allclose(prefix_weights(2, 1), weight[:2])
    x, target = torch.randn(1, 3, 2).double(), torch.cat([left, torch.zeros(1, 2)])[None]
    wanted = x
    for s, strength in ((0.0, 5.0), (0.5, min(5.0, (0.25 + 0.25) / 0.25))):
        end = lambda y, s=s: y + (1 - s) * torch.tanh(y.flip(1)) * (1 + s)  # noqa: E731
        jacobian = torch.autograd.functional.jacobian(end, wanted).reshape(6, 6)
        error = ((target - end(wanted)) * weight[:, None].double()).reshape(6)
        velocity = torch.tanh(wanted.flip(1)) * (1 + s)
        wanted = wanted + (velocity + strength * (error @ jacobian).reshape(1, 3, 2)) / 2
    found = head._continue(params, x, {0: Unfinished(left, 1)})
    np.testing.assert_allclose(found, wanted, atol=1e-6)


def test_the_soft_mask():
    """As the published code: ones, then x expm1(x) / (e - 1) with x falling evenly from 1 to 0, both left out."""
    for length, delay in ((8, 3), (5, 0), (4, 4), (2, 7), (0, 3)):
        bound = min(length, delay)
        falling = np.linspace(1, 0, length - bound + 2)[1:-1]
        wanted = [1.0] * bound + list(falling * np.expm1(falling) / (math.e - 1))
        np.testing.assert_allclose(prefix_weights(length, delay), wanted, atol=1e-6)


WORDS = [
    "chunks:make", "--suite", "libero_goal/1", "--episodes", "4", "--horizon", "12", "--threads", "1",
    "--protocol", "openpi", "--names", "protocol", "--json"
]  # fmt: skip


@pytest.fixture
def chunks(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    predicted = "np.tanh(np.arange(56).reshape(8, 7) * observations['state'][:, :7, None].swapaxes(1, 2))"
    own = "cameras, camera_size = ('agentview', 'robot0_eye_in_hand'), (16, 16)"
    write_policy(tmp_path / "chunks.py", predicted, own)
    return tmp_path


def result(folder) -> dict:
    return json.loads((folder / "eval.json").read_text())


@pytest.mark.sim
def test_an_evaluation_on_a_clock(chunks, capsys):
    for name, *words in (
        ("plain",), ("zero", "--clock", "latency=0s"), ("late", "--clock", "latency=uniform:50/400ms,every=2"),
        ("ones", "--clock", "latency=uniform:50/400ms,every=2", "--unit-starts", "1", "--workers", "2"),
        ("never", "--clock", "latency=60s"),
    ):  # fmt: skip
        assert main(["eval", *WORDS, "--out", name, *words]) == 0
        capsys.readouterr()
    plain, zero, late, ones, never = (result(chunks / n) for n in ("plain", "zero", "late", "ones", "never"))
    assert zero["actions"] == plain["actions"] and zero["outcomes"] == plain["outcomes"]
    assert zero["protocol"]["action"]["clock"] == "latency=0ms" and plain["protocol"]["action"]["clock"] == ""
    assert plain["tasks"][0]["timing"] == [] and zero["tasks"][0]["timing"] == [[3, 3, 0]] * 4
    assert late["actions"] == ones["actions"] != plain["actions"]
    assert late["tasks"][0]["timing"] == ones["tasks"][0]["timing"]
    assert len({tuple(row) for row in late["tasks"][0]["timing"]}) > 1
    assert never["tasks"][0]["timing"] == [[1, 0, 12]] * 4
    assert "0 of 4 answers used, waited in 100 % of the steps" in (chunks / "never" / "eval.html").read_text()

    assert main(["eval", "late/eval.json", "--allow", "chunks", "--out", "again"]) == 0
    assert "answers used, waited in" in capsys.readouterr().out
    assert result(chunks / "again")["actions"] == late["actions"]
    assert main(["compare", "now=plain", "late=late"]) == 2
    assert "protocol.action.clock" in capsys.readouterr().err
    assert main(["compare", "now=plain", "late=late", "--allow", "protocol.action.clock"]) == 0


@pytest.mark.sim
@pytest.mark.parametrize(("words", "told"), [
    (["expert", "--clock", "merge=ensemble"], "the policy answers with single actions"),
    (["chunks:make", "--clock", "merge=rtc"], "merge=rtc needs a policy that inpaints its chunks"),
    (["chunks:make", "--clock", "latency=-50ms"], "is not a number from 0"),
])  # fmt: skip
def test_a_clock_that_cannot_be_is_refused_before_anything_runs(chunks, words, told, capsys):
    assert main(["eval", *words, "--suite", "libero_goal/1", "--out", "found"]) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert told in error[-1] and len(error) <= 2 and not (chunks / "found").exists()


def test_an_event_is_told_to_those_who_hear():
    """A changed goal is refused for the others, which would go on with the former one."""
    told = []

    class Hearing(Counting):
        def hear(self, i, task):
            told.append((i, task))

    assert not isinstance(ClockedActor(Counting(3)), Hears)
    actor = ClockedActor(Hearing(3))
    assert isinstance(actor, Hears)
    actor.hear(1, "task")
    assert told == [(1, "task")]
