"""Sequences of calls of environments, with arguments of any kind: what is refused changes nothing."""

from functools import partial

import gymnasium
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from libero_env import BatchEnv, LiberoEnv
from libero_env.envs import EnvConfig
from tests.harness.fuzz import examples, survive

pytestmark = pytest.mark.sim

TASK, NUM = "libero_object/3", 2
EXTREME = (
    0.0, -0.0, 1.0, -1.0, 0.5, 1e-320, 1e-170, 1e10, -1e10, 1.1e10, 1e30, 1e308, np.nan, np.inf, -np.inf
)  # fmt: skip
STRANGE = (
    None, True, "1", "a", b"1", 1j, 10**400, -(10**30), (), [1], {}, object(), np.datetime64("2020-01-01")
)  # fmt: skip
KINDS = (
    list, tuple, np.float32, np.float16, np.int8, np.uint64, bool, complex, object, str, "masked", "torch"
)  # fmt: skip
values = st.sampled_from(EXTREME) | st.sampled_from(STRANGE) | st.integers(-3, 60) | st.floats()


@st.composite
def changed_array(draw, valid):
    """An array with other entries, another shape or another type, or something else."""
    flat = list(np.ravel(valid))
    for _ in range(draw(st.integers(0, 2))):
        flat[draw(st.integers(0, len(flat) - 1))] = draw(values)
    shape, what = np.shape(valid), draw(st.integers(0, 12))
    if what == 0:
        return draw(
            values | st.lists(values, max_size=3) | st.dictionaries(st.text(max_size=2), values, max_size=2)
        )
    if what == 1:
        del flat[draw(st.integers(0, len(flat) - 1)) :]
    if what == 2:
        flat += draw(st.lists(values, min_size=1, max_size=3))
    if what == 3:
        return [flat, flat[:-1]]
    try:
        array = np.array(flat, np.float64).reshape(shape if len(flat) == np.prod(shape) else -1)
    except (TypeError, ValueError, OverflowError):
        return [flat] if what == 4 else flat
    if what == 5:
        return array[None]
    if what == 6:
        with np.errstate(all="ignore"):
            return array * draw(st.sampled_from(EXTREME))
    if what < 10:
        return array
    return _as_kind(array, draw(st.sampled_from(KINDS)), draw(st.integers(0, max(array.size - 1, 0))))


def _as_kind(array, kind, index):
    if kind == "masked":
        return np.ma.masked_array(array, np.arange(array.size).reshape(array.shape) == index)
    if kind == "torch":
        import torch

        return torch.tensor(array, requires_grad=index % 2 == 1)
    if kind in (list, tuple):
        return kind(array)
    with np.errstate(all="ignore"):
        return array.astype(kind)


def changed_options(many):
    """Options of `reset` by name, known and unknown, with values of any kind."""
    index = values | st.lists(values, max_size=3) | st.integers(0, 49)
    states = changed_array(np.zeros((NUM, 110)) if many else np.zeros(3))
    known = {"init_state": index, "reset_mask": index, "start": states, "outdated_controller": values}
    named = st.fixed_dictionaries({}, optional={**known, "int_state": values})
    return st.none() | named | values | st.dictionaries(values.filter(_is_hashable), values, max_size=2)


def _is_hashable(value):
    return value.__hash__ is not None


def arguments(many, state):
    """Calls: name of the method -> strategy of its arguments."""
    action = changed_array(np.zeros((NUM, 7) if many else 7) + 0.1)
    rows = (values,) if many else ()
    seeds = values | st.integers(0, 2**70) | st.lists(values, max_size=3)
    return st.one_of(
        st.tuples(st.just("reset"), st.tuples(seeds, changed_options(many))),
        st.tuples(st.just("step"), st.tuples(action)),
        st.tuples(st.just("step"), st.tuples(action)),
        st.tuples(st.just("set_state"), st.tuples(*rows, changed_array(state))),
        st.tuples(
            st.just("set_state"), st.tuples(*(st.integers(0, NUM - 1) for _ in rows), changed_array(state))
        ),
        st.tuples(st.just("get_state"), st.tuples(*rows)),
        st.tuples(
            st.just("render_cameras"), st.tuples(*(st.lists(values, max_size=2) | values for _ in rows))
        ),
        st.tuples(st.just("render"), st.just(())),
    )


def call(env, name, given):
    """Call a method; True says that it did."""
    if name == "reset":
        env.reset(seed=given[0], options=given[1])
    else:
        getattr(env, name)(*given)
    return True


def digest(env):
    """All that the future of an environment depends on."""
    if isinstance(env, BatchEnv):
        states = np.array([env.get_state(i) for i in range(NUM)])
        return states.tobytes(), env.running.tobytes(), str([g.bit_generator.state for g in env.generators])
    return env.get_state().tobytes(), env.batch.running.tobytes(), str(env.np_random.bit_generator.state)


@pytest.fixture(scope="module")
def single():
    with LiberoEnv(TASK, cameras=(), horizon=6) as env:
        yield env


@pytest.fixture(scope="module")
def batch():
    with BatchEnv(TASK, NUM, cameras=(), horizon=6) as env:
        yield env


@given(data=st.data(), many=st.booleans())
@examples(short=25, long=1500)
def test_refused_calls_change_nothing(single, batch, data, many):
    env = batch if many else single
    env.reset(seed=0, options={"init_state": 0})
    calls = arguments(many, env.get_state(0) if many else env.get_state())
    for _ in range(4):
        name, given_ = data.draw(calls)
        before, was_running = digest(env), running(env)
        attempt = partial(call, env, name, given_)
        done = survive("environment", attempt, allowed=(gymnasium.error.Error,))
        failed_placement = name == "reset" and was_running.any() and not running(env).all()
        assert done or digest(env) == before or failed_placement, (name, given_)


def running(env):
    return np.atleast_1d(env.running if isinstance(env, BatchEnv) else env.batch.running)


FIELDS = list(EnvConfig.__dataclass_fields__)


@given(st.fixed_dictionaries({}, optional={name: values | st.lists(values, max_size=3) for name in FIELDS}))
@examples(short=60, long=3000)
def test_any_options_make_a_configuration_or_are_refused(options):
    survive("environment options", lambda: EnvConfig(**options))
