from .placement import sample_settled, settle, start_errors
from .store import (
    NUM_INIT_STATES,
    cache_init_states,
    generate_init_states,
    load_init_states,
    shipped_path,
    write_suite,
)

__all__ = [
    "NUM_INIT_STATES",
    "cache_init_states",
    "generate_init_states",
    "load_init_states",
    "sample_settled",
    "settle",
    "shipped_path",
    "start_errors",
    "write_suite",
]
