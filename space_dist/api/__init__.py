"""What the command does, for scripts and notebooks: `train`, `run_grid`, `report_on`, `load_policy` (docs/python.md).

    run = space_dist.train("shipped:pointmass_space", overrides={"budget.steps": 20_000}, workers=0)
    run.final, run.rows(), run.policy().predict(observation)

All of it is `space_dist.NAME`, imported when it is first asked for: `import space_dist` alone costs next to nothing,
and whoever works through a frozen grid waits neither for torch nor for figures.
"""
