"""The builtin pack: objects generated in code; `BUILDERS` maps category to builder."""

from types import MappingProxyType
from typing import Any

from libero_env.objects.builtin.appliances import LOOKS as _APPLIANCES
from libero_env.objects.builtin.assemble import builders_of
from libero_env.objects.builtin.basket import LOOKS as _BASKET
from libero_env.objects.builtin.books import LOOKS as _BOOKS
from libero_env.objects.builtin.bottles import LOOKS as _BOTTLES
from libero_env.objects.builtin.boxes import LOOKS as _BOXES
from libero_env.objects.builtin.cabinets import LOOKS as _CABINETS
from libero_env.objects.builtin.cans import LOOKS as _CANS
from libero_env.objects.builtin.cartons import LOOKS as _CARTONS
from libero_env.objects.builtin.containers import LOOKS as _CONTAINERS
from libero_env.objects.builtin.cookware import LOOKS as _COOKWARE
from libero_env.objects.builtin.fittings import LOOKS as _FITTINGS
from libero_env.objects.builtin.mugs import LOOKS as _MUGS
from libero_env.objects.builtin.racks import LOOKS as _RACKS
from libero_env.objects.builtin.shelves import LOOKS as _SHELVES
from libero_env.objects.builtin.tableware import LOOKS as _TABLEWARE
from libero_env.objects.builtin.zone import BUILDERS as _ZONES

_LOOKS: dict[str, Any] = {
    **_APPLIANCES,
    **_BASKET,
    **_BOOKS,
    **_BOTTLES,
    **_BOXES,
    **_CABINETS,
    **_CANS,
    **_CARTONS,
    **_CONTAINERS,
    **_COOKWARE,
    **_FITTINGS,
    **_MUGS,
    **_RACKS,
    **_SHELVES,
    **_TABLEWARE,
}
BUILDERS = MappingProxyType({**builders_of(_LOOKS), **_ZONES})
