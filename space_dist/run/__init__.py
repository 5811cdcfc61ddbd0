"""One run: `training` is its loop, `building` makes its parts, `cluster` does its work.

`claiming` makes its folder this run's, or refuses to; `launch` starts it.
"""
