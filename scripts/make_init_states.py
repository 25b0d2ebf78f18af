"""Make the stored initial states of a suite anew: python scripts/make_init_states.py libero_object."""

import sys

from libero_env.init_states import shipped_path, write_suite
from libero_env.scene import build_scene
from libero_env.tasks import get_suite

for name in sys.argv[1:] or ["libero_object"]:
    path = shipped_path(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_suite(path, [(task, build_scene(task.problem)) for task in get_suite(name).tasks])
    print(path, path.stat().st_size, "bytes")
