"""The builtin pack: objects generated in code. `BUILDERS` maps a category to the function that builds it."""

from types import MappingProxyType
from typing import Any

from libero_env.objects.builtin.appliances import APPEARANCES as _APPLIANCES
from libero_env.objects.builtin.assemble import builders_of
from libero_env.objects.builtin.basket import APPEARANCES as _BASKET
from libero_env.objects.builtin.books import APPEARANCES as _BOOKS
from libero_env.objects.builtin.bottles import APPEARANCES as _BOTTLES
from libero_env.objects.builtin.boxes import APPEARANCES as _BOXES
from libero_env.objects.builtin.cabinets import APPEARANCES as _CABINETS
from libero_env.objects.builtin.cans import APPEARANCES as _CANS
from libero_env.objects.builtin.cartons import APPEARANCES as _CARTONS
from libero_env.objects.builtin.containers import APPEARANCES as _CONTAINERS
from libero_env.objects.builtin.cookware import APPEARANCES as _COOKWARE
from libero_env.objects.builtin.fittings import APPEARANCES as _FITTINGS
from libero_env.objects.builtin.mugs import APPEARANCES as _MUGS
from libero_env.objects.builtin.racks import APPEARANCES as _RACKS
from libero_env.objects.builtin.shelves import APPEARANCES as _SHELVES
from libero_env.objects.builtin.tableware import APPEARANCES as _TABLEWARE
from libero_env.objects.builtin.zone import BUILDERS as _ZONES

_APPEARANCES: dict[str, Any] = {
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
BUILDERS = MappingProxyType({**builders_of(_APPEARANCES), **_ZONES})
