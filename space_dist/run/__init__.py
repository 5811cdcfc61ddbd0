"""One run: `training` is its loop, `building` makes its parts, `cluster` does its work, `claiming` makes a folder its own, `launch` starts it."""
