"""Many runs: `planning` freezes them, `conductor` sees to their ends: here (`warm`), on Ray (`pool`, `jobs`)."""
