"""Train one run: `ray job submit --working-dir . -- python jobs/train.py configs/pointmass_space.yaml`.

Takes the arguments of `space-dist train`. Inside a Ray job the run joins that cluster, and its folder is below
`~/space_dist/runs` unless `--out` names another absolute one.
"""

import sys

from space_dist.cli import main
from space_dist.system.workplace import in_ray_job

if __name__ == "__main__":
    arguments = ["train", *sys.argv[1:]]
    if in_ray_job() and not any("resources.address" in argument for argument in arguments):
        arguments += ["--set", "resources.address=auto"]
    sys.argv[1:] = arguments
    main()
