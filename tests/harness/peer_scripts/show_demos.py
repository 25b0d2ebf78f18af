"""Write a demonstration file with `libero demos show` and read it with Rerun: rows and shapes by entity, as JSON.

python show_demos.py FILE OUT
"""

import json
import sys

from rerun.chunk import RrdReader

from libero_cli.main import main

file, out = sys.argv[1:]
assert main(["demos", "show", file, "--rerun", out]) == 0
reader = RrdReader(out)
(store,) = reader.recordings()
rows, columns, times = {}, {}, {}
for chunk in reader.stream(store=store):
    path = chunk.entity_path
    rows[path] = rows.get(path, 0) + chunk.num_rows
    batch = chunk.to_record_batch()
    columns.setdefault(path, {}).update(
        {name: batch[name].to_pylist() for name in batch.schema.names if ":scalars" in name}
    )
    if not chunk.is_static:
        times[path] = sorted(chunk.timeline_names)
    texts = [name for name in batch.schema.names if name.endswith((":text", "AnnotationContext:context"))]
    columns[path].update({name: str(batch[name].to_pylist()) for name in texts})
print(json.dumps({"rows": rows, "columns": columns, "times": times}))
