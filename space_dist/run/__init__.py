"""One run: `training` is its loop, `building` makes its parts, `cluster` does its work, `launch` starts it."""
