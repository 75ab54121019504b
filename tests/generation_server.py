"""Generate data sets in child processes that a test may kill; run as a program.

The arguments are folders for data sets to begin with: of one episode a task, and of all. Then each line on
stdin names a folder, in which a child begins to generate at once, and the answer is its process id. An empty
line is answered with its exit status when it has ended.
"""

import os
import sys
from pathlib import Path

from openvima.data import generate
from small_data_sets import config

EPISODES = 12


def main() -> None:
    """Serve until stdin ends."""
    small, whole = map(Path, sys.argv[1:])
    generate(config(small, episodes=1))
    generate(config(whole, episodes=EPISODES))
    child = 0
    print("ready", flush=True)
    for line in map(str.strip, sys.stdin):
        if not line:
            print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
            continue
        child = os.fork()
        if child == 0:
            generate(config(Path(line), episodes=EPISODES))
            os._exit(0)
        print(child, flush=True)


if __name__ == "__main__":
    main()
