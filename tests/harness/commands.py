"""Run commands of `libero` one after the other in this process: lists of words in, a line of JSON for each out.

Patterns of files are expanded, as a shell does.

Written to the standard output: the status, what it printed and what it printed on the standard error.
"""

import contextlib
import glob
import io
import json
import sys

from libero_cli.main import main

if __name__ == "__main__":
    results, sys.stdout = sys.stdout, sys.stderr
    for given in json.load(sys.stdin):
        words = [name for word in given for name in (sorted(glob.glob(word)) or [word])]
        out, err = io.StringIO(), io.StringIO()
        sys.argv = ["libero", *words]
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                status = main(words)
            except SystemExit as error:
                status = error.code
        print(json.dumps([status, out.getvalue(), err.getvalue()]), file=results, flush=True)
