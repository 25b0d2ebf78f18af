"""A run's whole configuration, checked before anything is built or written."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, get_type_hints

from libero_env.errors import InvalidInputError
from libero_env.text import suggest
from libero_env.validation import validate_arguments
from lifelong.errors import ConfigError
from lifelong.settings.nodes import as_truth, build_checked, node_faults, raise_faults
from lifelong.settings.run import RunSettings
from lifelong.settings.targets import GROUPS, group_kind

_GIVEN = {"policy": ("spec",)}  # arguments that the configuration does not have
_STRICT = (
    "algo",
    "policy",
)  # groups in which a user's own class must be derived from ours; others may resemble it


@dataclass(frozen=True)
class Configuration:
    """The configuration of a run as plain data.

    Attributes:
        values: Keys at the top, and the nodes of the groups.
        source: File that it was read from, for error messages; empty where it was composed.
        allowed: Packages besides this one that may be named in it; see `find_target`. None: the user has composed it,
            and may name anything.
    """

    values: Mapping[str, Any]
    source: str = ""
    allowed: Sequence[str] | None = None

    def check(self) -> None:
        """Check all keys.

        Raises:
            ConfigError: A key is unknown or missing, or a value is of another kind or outside of its range; all that is
                wrong is listed.
        """
        valid = [*RunSettings.__dataclass_fields__, *GROUPS]
        faults = [
            f"{key} is an unknown key.{suggest(key, valid)} Valid: {', '.join(valid)}"
            for key in self.values
            if key not in valid
        ]
        raise_faults(
            [*faults, *self._faults(tuple(GROUPS), tuple(RunSettings.__dataclass_fields__))], self.source
        )

    def check_some(self, groups: Sequence[str], keys: Sequence[str] = ()) -> None:
        """Check the nodes of some groups and some keys at the top; the others may be of an earlier version.

        Raises:
            ConfigError: As of `check`.
        """
        raise_faults(self._faults(groups, keys), self.source)

    def _faults(self, groups: Sequence[str], keys: Sequence[str]) -> list[str]:
        top = {key: self.values[key] for key in keys if key in self.values}
        faults = [f"{key} is missing" for key in keys if key not in top]
        types = get_type_hints(RunSettings, include_extras=True)
        try:
            validate_arguments(RunSettings, {k: as_truth(v, types.get(k)) for k, v in top.items()})
        except InvalidInputError as error:
            faults.append(str(error))
        return faults + [fault for group in groups for fault in self._group_faults(group)]

    def settings(self) -> RunSettings:
        """Return the keys at the top."""
        return RunSettings(**{key: value for key, value in self.values.items() if key not in GROUPS})

    def is_own(self, group: str) -> bool:
        """Return whether a group and all of its components are classes of this package."""
        return all(name.startswith("lifelong.") for name in _targets(self.values[group]))

    def build(self, group: str, **arguments: Any) -> Any:
        """Build what a group describes.

        Args:
            group: Name of the group.
            arguments: Further keyword arguments of its target.

        Raises:
            ConfigError: The node is not valid, or builds something else than the group is for.
        """
        self.check_some([group])
        built = build_checked(self.values[group], self.allowed, **arguments)
        if group in _STRICT and not isinstance(built, group_kind(group)):
            raise ConfigError(
                f"{group} builds a {type(built).__name__}; expected a {group_kind(group).__name__}"
            )
        return built

    def _group_faults(self, group: str) -> list[str]:
        if group not in self.values:
            return [f"{group} is missing; choose a file of that group with {group}=NAME"]
        return list(
            node_faults(
                self.values[group],
                (group,),
                given=_GIVEN.get(group, ()),
                kind=group_kind(group),
                strict=group in _STRICT,
                allowed=self.allowed,
            )
        )


def _targets(node: Any) -> list[str]:
    """Return all `_target_`s within a value."""
    if isinstance(node, Mapping):
        return [
            name
            for key, part in node.items()
            for name in ([str(part)] if key == "_target_" else _targets(part))
        ]
    return [name for part in node for name in _targets(part)] if isinstance(node, list | tuple) else []
