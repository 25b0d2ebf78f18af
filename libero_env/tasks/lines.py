"""Line numbers of the parts of a task file."""

from collections.abc import Iterator

from libero_env.tasks.sexpr import List, Word


class Lines:
    """Line numbers of the parts of a task file.

    Attributes:
        entities: Name of an object or fixture -> line.
        regions: Address of a region -> line.
        init: Line of each init atom.
        goal: Line of each atom of the goal, in reading order.
    """

    def __init__(self, tree: List):
        self._sections = {node.head: node for node in tree.items if isinstance(node, List)}
        self.entities = {name: line for head in (":fixtures", ":objects") for name, line in self._names(head)}
        self.regions = dict(self._regions())
        self.init = [item.line for item in self._items(":init")]
        self.goal = [line for item in self._items(":goal") for line in _atom_lines(item)]

    def section(self, head: str) -> int:
        """Return the line of a section such as `:goal`; 1 where there is none."""
        return self._sections[head].line if head in self._sections else 1

    def of(self, name: str) -> int:
        """Return the line of the declaration of an object, fixture or region."""
        return self.entities.get(name, self.regions.get(name, 1))

    def of_part(self, section: str, index: int | str | None) -> int:
        """Return the line of a part of a section; see `libero_env.tasks.checks.Fault`."""
        lines = {":init": self.init, ":goal": self.goal}.get(section, [])
        if isinstance(index, int) and index < len(lines):
            return lines[index]
        known = {**self.entities, **self.regions} if isinstance(index, str) else {}
        return known.get(str(index), self.section(section))

    def _items(self, head: str) -> tuple[Word | List, ...]:
        return self._sections[head].items[1:] if head in self._sections else ()

    def _names(self, head: str) -> Iterator[tuple[str, int]]:
        items = [item for item in self._items(head) if isinstance(item, Word)]
        before = [None, *items[:-1]]
        for item, last in zip(items, before, strict=False):
            if item.text != "-" and (last is None or last.text != "-"):
                yield item.text, item.line

    def _regions(self) -> Iterator[tuple[str, int]]:
        for node in self._items(":regions"):
            if not isinstance(node, List) or not node.items or not isinstance(node.items[0], Word):
                continue
            for part in node.items[1:]:
                if isinstance(part, List) and part.head == ":target" and isinstance(part.items[-1], Word):
                    yield f"{part.items[-1].text}_{node.items[0].text}", node.line


def _atom_lines(node: Word | List) -> Iterator[int]:
    if isinstance(node, List) and node.head in ("and", "or", "not", "forall"):
        for part in node.items[2:] if node.head == "forall" else node.items[1:]:
            yield from _atom_lines(part)
    else:
        yield node.line
