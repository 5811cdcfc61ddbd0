"""What is around us: `files`, signals (`interrupts`), modules (`importing`), `processes`, `provenance`, `workplace`."""
