"""Predicates on object states; their truth is that of `libero_env.sim.predicates`."""

from libero.libero.envs.predicates.base_predicates import (
    BinaryAtomic,
    Close,
    Expression,
    FalsePredicateFn,
    In,
    InContactPredicateFn,
    MultiarayAtomic,
    On,
    Open,
    PrintJointState,
    Stack,
    TruePredicateFn,
    TurnOff,
    TurnOn,
    UnaryAtomic,
    Up,
)
from libero.libero.envs.predicates.registry import (
    VALIDATE_PREDICATE_FN_DICT,
    eval_predicate_fn,
    get_predicate_fn,
    get_predicate_fn_dict,
    update_predicate_fn_dict,
)
