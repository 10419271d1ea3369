"""Run scripts one after another in this process, since each alone would take long to import torch and LeRobot.

Prints where the package lies. Then, for every line of JSON with a folder, a script and its arguments, it runs the
script in the folder and prints exit code and output as a line of JSON.
"""

import contextlib
import io
import json
import os
import runpy
import sys
import traceback

import torch

import dynmap_rl


def run(folder: str, script: str, *arguments: str) -> tuple[int, str, str]:
    out, err, path, code = io.StringIO(), io.StringIO(), [*sys.path], 0
    sys.argv = [script, *arguments]
    with contextlib.chdir(folder), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            runpy.run_path(script, run_name="__main__")
        except SystemExit as end:
            code = end.code or 0
        except Exception:
            code = 1
            traceback.print_exc()
    sys.path[:] = path
    torch.set_num_threads(1)
    return code, out.getvalue(), err.getvalue()


if __name__ == "__main__":
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # for what libraries print past Python
    print(json.dumps(dynmap_rl.__file__), file=answers, flush=True)
    for line in sys.stdin:
        print(json.dumps(run(*json.loads(line))), file=answers, flush=True)
