"""Two texts that teach the original, block by block: what they tell people to type runs here.

The texts are not part of the repository; blocks.yaml says which block runs as typed and what others need.
"""

import io
import subprocess
from contextlib import redirect_stdout
from pathlib import Path

import pytest

from tests.walkthroughs.blocks import Block, digest, execute, left_out, load_blocks, reindent
from tests.walkthroughs.checks import CHECKS, Ran

CHAPTERS = list(dict.fromkeys(block.chapter for block in load_blocks()))


@pytest.mark.sim
@pytest.mark.slow
@pytest.mark.parametrize("chapter", CHAPTERS)
def test_chapter(chapter, blocks, texts, folder, request):
    """Every block does what the text says, with the names that the blocks before it have left."""
    if chapter in ("data", "render"):
        request.getfixturevalue("drawer")
    scope = {"__name__": "__main__"}
    for block in blocks:
        if block.chapter == chapter:
            ran = run(block, texts[block.text], scope, folder)
            if block.id in CHECKS:  # what others are for, the blocks behind them find
                CHECKS[block.id](ran)


def run(block: Block, text: list[str], scope: dict, folder: Path) -> Ran:
    source, out = block.source(text), io.StringIO()
    if block.kind == "python":
        with redirect_stdout(out):
            execute(block, text, scope)
    elif block.kind == "bash":
        done = subprocess.run(["bash", "-euc", f"{source}env"], capture_output=True, text=True, check=True)
        out.write(done.stdout)
    elif block.kind == "xml":
        (folder / block.file).write_text(source)
    return Ran(scope, out.getvalue(), source, folder)


def test_the_texts_are_those_of_the_manifest(blocks, texts):
    for block in blocks:
        lines = texts[block.text][block.lines[0] - 1 : block.lines[1]]
        assert digest(lines) == block.digest, f"{block.text}: block {block.id} is not what it was"
        inside = {*block.falls, *block.replace}
        assert inside <= set(block.numbers), f"{block.id} speaks of lines that are not its own"


def test_no_code_is_left_out(blocks, texts):
    for name, text in texts.items():
        listed = [block for block in blocks if block.text == name]
        assert left_out(text, listed) == []
        for block in listed:  # and it would be noticed
            assert left_out(text, [other for other in listed if other is not block]), block.id


def test_what_is_shown_is_checked_and_every_change_has_its_reason(blocks):
    ids = {block.id: block.kind for block in blocks}
    assert {name for name, kind in ids.items() if kind == "shown"} <= CHECKS.keys() <= ids.keys()
    changed = [block for block in blocks if block.given or block.replace or block.helpers]
    assert [block.id for block in changed if not block.why] == []


def test_indentation_comes_back():
    code = (
        'class A:\n    """Of b: c."""\n    def f(self):  # why:\n        if x:\n            y = {"a":\n1}\n'
        "        return [\n1]\n"
    )
    flat = [line.strip() for line in code.splitlines()]
    assert reindent(flat, {6: 2}).split() == code.split()
    compile(reindent(flat, {6: 2}), "a.py", "exec")
    assert "\n        return" in reindent(flat, {6: 2})
