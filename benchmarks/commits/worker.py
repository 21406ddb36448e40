"""The process that `compare` starts for each side: it uses one install, and leaves if it finds another.

Two tasks:

    python -P -m benchmarks.commits.worker SITE results FOLDER ENGINES SCENES
        # the arrays of one side, into the folder; of some engines and scenes, lists in JSON, or all if these are empty
    python -P -m benchmarks.commits.worker SITE speed FOLDER
        # answers requests; meshes are kept in the folder
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

# None of these imports rts before a function is called.
from benchmarks.commits.installs import check_origin, isolate
from benchmarks.commits.results import record_results
from benchmarks.commits.speed import serve

TASKS = {"results": record_results, "speed": serve}


def main() -> None:
    site, task, folder, *options = sys.argv[1:]
    isolate(Path(site))
    TASKS[task](Path(folder), *map(json.loads, options))
    check_origin(Path(site))


if __name__ == "__main__":
    main()
