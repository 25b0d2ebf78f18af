"""Results of evaluations and cards of protocols as others may have left them, through everything that reads them."""

import contextlib
import io
import json
from dataclasses import fields, replace

import yaml
from hypothesis import given

from libero_env.sim.costs import Costs
from libero_env.text import json_safe
from libero_env.validation import validate
from libero_eval.cli.compare import _single_groups
from libero_eval.evaluation_file import FILE_NAME, EvaluationResult, TaskResult
from libero_eval.judging.comparison import compare_groups, write_comparison
from libero_eval.judging.page import render
from libero_eval.protocols.files import load_protocol
from libero_eval.protocols.protocol import EvalProtocol
from libero_eval.repeating import repeated
from libero_eval.requests import EvalRequest
from libero_integrations.exports.results import export_lerobot, export_vla_eval
from tests.harness.fuzz import examples, survive
from tests.harness.mutations import changed_text, mutated
from tests.harness.results import drawn_result

CARD = json_safe(load_protocol("openpi").resolved())
PLAIN = drawn_result(0.7, 1, tasks=2, protocol=CARD)
COSTLY = tuple(replace(task, costs=(Costs(force=80.0, moved=("bowl_1",)), None) * 25) for task in PLAIN.tasks)
VALID = [
    replace(PLAIN, tasks=COSTLY).to_plain(),
    drawn_result(
        0.4, 2, tasks=1, evaluated={"run": "runs/a", "after": 1, "seed": 3}, unit_starts=10
    ).to_plain(),
]
REQUEST = EvalRequest(policy="here")


def sealed(values: object) -> object:
    """The same with the digest that its tasks have, where they are valid: the digest is no protection."""
    if isinstance(values, dict):
        with contextlib.suppress(Exception):
            names = [f.name for f in fields(TaskResult)]
            rows = [{name: row[name] for name in names if name in row} for row in values["tasks"]]
            tasks = tuple(validate(TaskResult, row) for row in rows)
            values["outcomes"] = EvaluationResult({}, {}, (), {}, tasks).outcomes
    return values


@given(values=mutated(VALID).map(sealed))
@examples(short=60, long=4000)
def test_any_result_is_used_or_refused(values, tmp_path_factory):
    folder = tmp_path_factory.getbasetemp() / "result"
    folder.mkdir(exist_ok=True)
    (folder / FILE_NAME).write_text(json.dumps(values))
    survive("results of evaluations", lambda: EvaluationResult.read(folder))

    def use() -> None:
        result = EvaluationResult.read(folder)
        repeated(REQUEST, result)
        export_lerobot(result, folder / "lerobot")
        export_vla_eval(result, folder / "vla-eval")
        found = compare_groups(_single_groups([str(folder), str(folder)]), control=None, allow=[], alpha=0.05)
        with contextlib.redirect_stdout(io.StringIO()):
            print(render(found, tasks=True))
        write_comparison(found, folder / "compare.json")

    survive("results of evaluations", use)
    survive(
        "results of evaluations", lambda: EvalProtocol.read(EvaluationResult.read(folder).protocol, "here")
    )


@given(text=changed_text(json.dumps(VALID[0])))
@examples(short=20, long=1000)
def test_any_text_of_a_result_is_read_or_refused(text, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "text.json"
    path.write_text(text)
    survive("results of evaluations", lambda: EvaluationResult.read(path))


@given(values=mutated([{"extends": "openpi"} | {k: CARD[k] for k in ("episode", "pixels")}, {**CARD}]))
@examples(short=40, long=2000)
def test_any_card_is_read_or_refused(values, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "cards" / "card.yaml"
    path.parent.mkdir(exist_ok=True)
    path.write_text(yaml.safe_dump(values), encoding="utf-8", errors="replace")
    survive("cards of protocols", lambda: load_protocol(str(path)).require())
