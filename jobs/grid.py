"""Work through a grid: `ray job submit --working-dir . -- python jobs/grid.py configs/grids/<grid>.yaml`.

Takes the arguments of `space-dist grid run`. Inside a Ray job the runs join that cluster, and results go below
`~/space_dist/runs` unless `--root` names another absolute folder.
"""

import sys

from space_dist.cli import main
from space_dist.system.workplace import in_ray_job

if __name__ == "__main__":
    arguments = ["grid", "run", *sys.argv[1:]]
    if in_ray_job() and not any(argument.partition("=")[0] == "--address" for argument in arguments):
        arguments += ["--address", "auto"]
    sys.argv[1:] = arguments
    main()
