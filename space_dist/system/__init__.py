"""What is around us: `files`, signals (`interrupts`), modules (`importing`), `provenance`, the `workplace`."""
