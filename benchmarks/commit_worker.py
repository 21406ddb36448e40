"""What `compare_commits` starts for each side: a process that uses one install, and leaves if it finds another.

python commit_worker.py SITE results FOLDER     # the arrays of one side, into the folder
python commit_worker.py SITE speed FOLDER       # answers requests; meshes are kept in the folder
"""

from __future__ import annotations

import sys
from pathlib import Path

# None of these imports rts before a function is called.
from commit_installs import check_origin, isolate
from commit_matrix import record_results
from commit_speed import serve

TASKS = {"results": record_results, "speed": serve}


def main() -> None:
    site, task, folder = sys.argv[1:]
    isolate(Path(site))
    TASKS[task](Path(folder))
    check_origin(Path(site))


if __name__ == "__main__":
    main()
