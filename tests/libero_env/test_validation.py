"""Values against annotated types: what is refused, and that the error says where, which value and what is valid."""

import dataclasses
import pickle
from typing import Annotated, Literal

import numpy as np
import pytest
from pydantic import Field
from typing_extensions import TypedDict

from libero_env.errors import InvalidInputError, LiberoError
from libero_env.validation import OneOf, checked, validate, validate_arguments

Share = Annotated[float, Field(gt=0, le=1)]


@dataclasses.dataclass(frozen=True)
class Part:
    share: Share
    count: int = 1


class Content(TypedDict, total=False):
    parts: list[Part]
    names: Annotated[list[Annotated[str, OneOf(("bowl", "plate"))]], Field(min_length=1, max_length=2)]
    mode: Literal["fast", "faithful"] | None
    done: bool


@pytest.mark.parametrize(("value", "message"), [
    ({"parts": 5}, "parts is 5; expected a valid array"),
    ({"parts": [{"share": 0}]}, "parts.0.share is 0; expected greater than 0"),
    ({"parts": [{"share": "1"}]}, "parts.0.share is '1'; expected a valid number"),
    ({"parts": [{"share": float("nan")}]}, "parts.0.share is nan; expected a finite number"),
    ({"parts": [{"share": 1, "count": True}]}, "parts.0.count is True; expected a valid integer"),
    ({"parts": [{}]}, "parts.0.share is missing"),
    ({"parts": [{"share": 1, "cuont": 2}]}, "parts.0.cuont is an unknown key. Did you mean 'count'? Valid: "),
    ({"names": ["bowl"] * 3}, "should have at most 2 items"),
    ({"names": ["plat"]}, "expected 'bowl' or 'plate'. Did you mean 'plate'?"),
    ({"mode": "fsat"}, "expected 'fast' or 'faithful'. Did you mean 'fast'?"),
    ({"done": 1}, "done is 1; expected a valid boolean"),
    ({5: 1}, "the key 5 is not a text"),
    ([1], "is [1]; expected an object"),
])  # fmt: skip
def test_a_wrong_value_is_named(value, message):
    with pytest.raises(LiberoError) as caught:
        validate(Content, value)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_right_values_are_built_and_have_lines_where_they_are_wrong():
    content = validate(Content, {"parts": [{"share": np.float32(0.5)}], "mode": None})
    assert content == {"parts": [Part(0.5)], "mode": None}
    with pytest.raises(InvalidInputError, match=r"^a\.yaml:7: with\.mode is 5; expected"):
        validate(Content, {"mode": 5}, source="a.yaml", prefix=["with"], line_of=lambda path: 7)
    with pytest.raises(InvalidInputError, match="; and 2 more$"):
        validate(list[int], ["x"] * 6)


def test_arguments_are_checked_by_a_signature():
    def make(count: int, *, share: Share = 1.0, other=None): ...

    validate_arguments(make, {"share": 0.5, "other": object})
    with pytest.raises(InvalidInputError, match=r"^policy\.share is 2; expected less than or equal to 1$"):
        validate_arguments(make, {"share": 2}, prefix=["policy"])


@checked
class Box:
    """A box."""

    size: Annotated[float, Field(gt=0)]
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.size > 10:
            raise LiberoError("too large")


def test_a_checked_class_is_a_frozen_dataclass():
    box = Box(1, ("a",))
    assert box == dataclasses.replace(Box(2.0, names=("a",)), size=1.0) == pickle.loads(pickle.dumps(box))  # noqa: S301
    assert hash(box) == hash(Box(1.0, ("a",))) and dataclasses.asdict(box) == {"size": 1.0, "names": ("a",)}
    with pytest.raises(dataclasses.FrozenInstanceError):
        box.size = 2.0


@pytest.mark.parametrize(("make", "message"), [
    (lambda: Box(0), "Box: size is 0; expected greater than 0"),
    (lambda: Box(1, ["a"]), "Box: names is ['a']; expected a valid tuple"),
    (lambda: Box(), "Box: size is missing"),
    (lambda: Box(1, nmaes=()), "Box: nmaes is an unknown key. Did you mean 'names'? Valid: size, names"),
    (lambda: Box(11), "too large"),
])  # fmt: skip
def test_its_constructor_checks(make, message):
    with pytest.raises(LiberoError) as caught:
        make()
    assert str(caught.value) == message
