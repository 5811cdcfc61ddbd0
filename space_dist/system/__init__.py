"""What is around us: `files`, signals (`interrupts`), modules (`importing`), `processes`, `provenance`, `workplace`.

`import_paths` and `arguments` say what is meant by a wrong one.
"""
