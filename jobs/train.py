"""Train one run: `ray job submit --working-dir . -- python jobs/train.py CONFIG --out /shared/run`.

Takes the arguments of `space-dist train`. Inside a Ray job (RAY_ADDRESS is set there) the run joins that cluster.
"""

import os
import sys

from space_dist.cli import main

if __name__ == "__main__":
    arguments = ["train", *sys.argv[1:]]
    if os.environ.get("RAY_ADDRESS") and not any("resources.address" in argument for argument in arguments):
        arguments += ["--set", "resources.address=auto"]
    sys.argv[1:] = arguments
    main()
