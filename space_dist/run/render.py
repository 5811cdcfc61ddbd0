"""What a run's policy does, to look at: GIFs of episodes, and many trajectories side by side.

PointMass, CartPole and Maze are drawn here from their contexts and observations; any other environment draws itself
(`Drawable`). Episodes are those of the run's own evaluation: deterministic, with its seeds.
"""

from __future__ import annotations

import contextlib
import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from space_dist import config as configs
from space_dist.config import RunConfig
from space_dist.envs import Drawable, KnowsOptimum, close, takes_argument, unwrapped
from space_dist.envs.cartpole import ANGLE_LIMIT, X_LIMIT
from space_dist.envs.goalmaze import BLOCK, WALL
from space_dist.envs.layouts import cut_out, shortest_ways, successors
from space_dist.envs.observations import take
from space_dist.envs.pointmass import GOAL, POSITION_LIMIT, SUCCESS_DISTANCE
from space_dist.envs.spec import read_spec
from space_dist.errors import ConfigError, LedgerError
from space_dist.instances import InstanceSet, read_csv
from space_dist.ledger import Ledger
from space_dist.rollout import Split
from space_dist.rollout.memory import Memory
from space_dist.rollout.policy import Policy, policies_of
from space_dist.run.launch import policy_of
from space_dist.seeding import Purpose, episode_seeds
from space_dist.system.files import atomic_write

MAX_FRAMES: Final = 120  # of a GIF; of longer episodes only every second, third, ... step is shown
PANELS: Final = 5  # a side of the square of trajectories
END_MILLISECONDS: Final = 1500  # the last picture stays
_DPI: Final = 100
_INK, _GOOD, _BAD, _PATH, _PALE = "#222222", "#009E73", "#D55E00", "#0072B2", "#DDDDDD"  # Okabe and Ito's palette
_SPLITS: Final[tuple[Split, ...]] = ("train", "test")

Frame = NDArray[np.uint8]


@dataclass(frozen=True)
class Episode:
    """One episode of a policy.

    split, id: the instance.  observations: (length + 1, ...) without the context.  success: None if not known.
    optimum: the highest return there is, if it is known.
    """

    split: Split
    id: int
    context: NDArray[np.float64]
    observations: NDArray[Any]
    total: float
    success: bool | None
    optimum: float | None

    @property
    def length(self) -> int:
        """Steps."""
        return len(self.observations) - 1

    @property
    def outcome(self) -> str:
        """In a few words."""
        reached = "" if self.success is None else ", success" if self.success else ", no success"
        best = "" if self.optimum is None else f" of {self.optimum:.4g}"
        return f"return {self.total:.4g}{best}{reached}"


class Scene(Protocol):
    """How one environment is drawn."""

    milliseconds: int  # a step lasts in a GIF
    height: float  # of a GIF's picture, in inches, where it is 4 wide
    whole: bool  # whether one picture tells a whole episode

    def prepare(self, axes: Axes, context: NDArray[np.float64]) -> Callable[[NDArray[Any]], Sequence[Artist]]:
        """Draw what stands still; returns what draws an episode so far, `(steps + 1, ...)`, and says what moves."""

    def order(self, contexts: NDArray[np.float64]) -> list[int]:
        """At most `PANELS` squared of the `(n, d)` contexts, so arranged, row by row, that neighbours are similar."""

    def caption(self, episode: Episode) -> str:
        """The context in a few words."""


class Gallery:
    """A run's policy, ready to be looked at. Raises LedgerError if the run has none yet."""

    def __init__(self, ledger: Ledger) -> None:
        self._config: RunConfig = configs.load(ledger.config)
        env = self._config.env
        picture = {"render_mode": "rgb_array"} if takes_argument(env.id, "render_mode") else {}
        spec = read_spec(env.id, context_visible=env.context_visible, kwargs={**env.kwargs, **picture})
        self._policy: Policy = policies_of(policy_of(ledger, spec))[0]  # the first, where the run trains several
        self._sets: dict[Split, InstanceSet] = {
            split: read_csv(ledger.instances(split), spec.context_bounds) for split in _SPLITS
        }  # fmt: skip
        self._seeds = {
            split: episode_seeds(
                self._config.seed, Purpose.EVALUATION, index, count=len(self._sets[split]) * episodes
            # The first episode of each instance, of those that evaluation plays.
            )[::episodes]
            for episodes in [self._config.evaluation.episodes]
            for index, split in enumerate(_SPLITS)
        }  # fmt: skip
        self._scene = _SCENES.get(self._config.env.id)
        self.name = f"{self._config.name}, seed {self._config.seed}"
        self._env = spec.make(1)

    def close(self) -> None:
        """Close the environment."""
        close(self._env)

    def find(self, ids: Sequence[int]) -> list[tuple[Split, int]]:
        """The set that holds each id, and its place there. Raises ConfigError for ids that are in neither or both."""
        found = []
        for wanted in ids:
            places: list[tuple[Split, int]] = [
                (split, int(np.flatnonzero(self._sets[split].ids == wanted)[0]))
                for split in _SPLITS if wanted in self._sets[split].ids
            ]  # fmt: skip
            if len(places) != 1:
                held = "; ".join(f"{split}: {_ranges(self._sets[split].ids)}" for split in _SPLITS)
                where = "neither set of the run" if not places else "both sets of the run"
                mend = "; only ids that one set alone has can be chosen" if places else ""
                raise ConfigError(f"--instances: {wanted} is the id of an instance of {where} (ids of {held}){mend}")
            found += places
        return found

    def some(self) -> list[tuple[Split, int]]:
        """The first, a middle and the last instance of the test set."""
        n = len(self._sets["test"])
        return [("test", place) for place in sorted({0, n // 2, n - 1})]

    def gif(self, split: Split, place: int, folder: Path) -> tuple[Path, Episode]:
        """Write `<split>_<id>.gif`. Raises ConfigError if the environment cannot be drawn."""
        frames: dict[int, Frame] = {}
        if self._scene is None:
            if not isinstance(unwrapped(self._env), Drawable):
                raise ConfigError(f"{self._config.env.id} cannot be drawn: it has no frame(slot)")
            every = _stride(self._env.horizon + 1)
            episode = self._play(split, place, frames, every)
            pictures = [_labelled(frame, episode, step) for step, frame in frames.items()]
            milliseconds = 50
        else:
            episode = self._play(split, place)
            every = _stride(len(episode.observations))
            pictures = _animation(self._scene, episode, every)
            milliseconds = self._scene.milliseconds
        path = folder / f"{split}_{episode.id}.gif"
        _write_gif(path, pictures, every * milliseconds)
        return path, episode

    def trajectories(self, split: Split, folder: Path) -> list[Path]:
        """Write `trajectories_<split>.png`, small multiples over the contexts, where one picture tells an episode."""
        if self._scene is None or not self._scene.whole:
            return []
        scene = self._scene
        instances = self._sets[split]
        shown = [self._play(split, place) for place in scene.order(instances.contexts)]
        columns = min(PANELS, len(shown))
        rows = math.ceil(len(shown) / columns)
        figure = Figure(figsize=(max(2.0 * columns, 6.0), 2.25 * rows + 0.7), layout="constrained", facecolor="white")
        # Not pyplot, which keeps every figure alive until somebody closes it.
        FigureCanvasAgg(figure)
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes in panels[len(shown) :]:
            axes.axis("off")
        for axes, episode in zip(panels, shown, strict=False):
            scene.prepare(axes, episode.context)(episode.observations)
            colour = _INK if episode.success is None else _GOOD if episode.success else _BAD
            axes.set_title(f"{episode.id}: {scene.caption(episode)}", fontsize=7.5, color=colour, pad=3)
        succeeded = [episode.success for episode in shown if episode.success is not None]
        result = f": success on {sum(succeeded)} of {len(succeeded)} (green)" if succeeded else ""
        title = f"{self.name}, {len(shown)} of {len(instances)} {split} instances{result}"
        figure.suptitle(title, fontsize=10)
        path = folder / f"trajectories_{split}.png"
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=_DPI)
        atomic_write(path, buffer.getvalue())
        return [path]

    def _play(
        self, split: Split, place: int, frames: dict[int, Frame] | None = None, every: int = 1
    ) -> Episode:  # fmt: skip
        """One deterministic episode; `frames` takes pictures of its start, of every so many steps and of its end."""
        env, world, instances = self._env, unwrapped(self._env), self._sets[split]
        context = instances.contexts[place : place + 1]
        # Scenes draw the state; the context is at the end of an observation where the policy sees it.
        n_features = context.shape[1] if self._config.env.context_visible else 0

        def look(over: bool) -> None:
            if frames is not None and isinstance(world, Drawable) and (over or len(seen) % every == 0):
                frames[len(seen)] = world.frame(0)
            seen.append(np.array(observations[0, : observations.shape[1] - n_features]) if flat else np.zeros(0))

        observations: Any = take(
            env.reset(np.array([0]), context, self._seeds[split][place : place + 1]), slice(None)
        )  # fmt: skip
        flat = isinstance(observations, np.ndarray) and observations.ndim == 2
        seen: list[NDArray[Any]] = []
        total, success = 0.0, None
        look(over=False)
        memory = Memory(self._policy, 1)
        for _ in range(env.horizon):
            head = self._policy.head
            step = env.step(head.executed(head.best(memory.outputs(observations))))
            observations = take(step.observations, slice(None))
            total += float(step.rewards[0])
            success = None if step.success is None else bool(step.success[0])
            over = bool(step.terminated[0] or step.truncated[0])
            look(over)
            if over:
                break
        optimum = float(world.optimal_returns(context)[0]) if isinstance(world, KnowsOptimum) else None
        return Episode(split, int(instances.ids[place]), context[0], np.array(seen), total, success, optimum)


def draw_run(ledger: Ledger, folder: Path, ids: Sequence[int] | None = None) -> list[tuple[Path, str]]:
    """Write a GIF for each instance (without `ids`: three of the test set) and what trajectories there are.

    Returns (file, what happened in it). Raises ConfigError for unknown ids or an environment that cannot be drawn,
    LedgerError if there is no run, no policy, or a file cannot be written.
    """
    ledger.status()
    with contextlib.closing(Gallery(ledger)) as gallery:
        chosen = gallery.some() if ids is None else gallery.find(ids)
        written = []
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for split, place in chosen:
                path, episode = gallery.gif(split, place, folder)
                written.append((path, f"{split} instance {episode.id}: {episode.outcome}, {episode.length} steps"))
            for split in _SPLITS:
                pictures = gallery.trajectories(split, folder)
                written += [(path, f"trajectories on {split} instances") for path in pictures]
        except OSError as error:
            raise LedgerError(f"cannot write to {folder}: {error.strerror or error}") from None
    return written


# ---- the scenes -----------------------------------------------------------------------------------------------------


class _PointMass:
    milliseconds, height, whole = 100, 4.4, True  # real time

    def prepare(self, axes: Axes, context: NDArray[np.float64]) -> Callable[[NDArray[Any]], Sequence[Artist]]:
        gate_x, gate_width, _ = context
        limit = POSITION_LIMIT
        _bare(axes, (-limit - 0.1, limit + 0.1), (-limit - 0.1, limit + 0.1))
        for left, right in ((-limit, gate_x - gate_width / 2), (gate_x + gate_width / 2, limit)):
            if right > left:
                axes.add_patch(Rectangle((left, -0.08), right - left, 0.16, color=_INK, lw=0))
        axes.add_patch(Circle((GOAL[0], GOAL[1]), SUCCESS_DISTANCE, color=_GOOD, alpha=0.35, lw=0))
        axes.plot(*GOAL, marker="+", color=_GOOD, markersize=5)
        axes.plot(0.0, 3.0, marker="o", color=_PALE, markersize=4)
        (path,) = axes.plot([], [], color=_PATH, lw=1.2)
        (mass,) = axes.plot([], [], marker="o", color=_PATH, markersize=4.5, linestyle="none")

        def show(observations: NDArray[Any]) -> Sequence[Artist]:
            x, y = observations[:, 0], observations[:, 2]
            path.set_data(x, y)
            mass.set_data(x[-1:], y[-1:])
            crashed = len(y) > 1 and y[-1] == 0.0
            mass.set_color(_BAD if crashed else _PATH)
            mass.set_marker("X" if crashed else "o")
            return path, mass

        return show

    def order(self, contexts: NDArray[np.float64]) -> list[int]:
        """Columns from left gates to right ones, rows from wide gates to narrow ones."""
        chosen = _spread(np.argsort(contexts[:, 0], kind="stable"))
        columns = [
            sorted(chosen[start : start + PANELS], key=lambda place: -contexts[place, 1])
            for start in range(0, len(chosen), PANELS)
        ]
        return [column[row] for row in range(PANELS) for column in columns if row < len(column)]

    def caption(self, episode: Episode) -> str:
        gate_x, gate_width, friction = episode.context
        return f"gate {gate_x:.1f}, width {gate_width:.1f}, friction {friction:.1f}"


class _CartPole:
    milliseconds, height, whole = 20, 2.6, False  # real time

    def prepare(self, axes: Axes, context: NDArray[np.float64]) -> Callable[[NDArray[Any]], Sequence[Artist]]:
        pole = 2.0 * float(context[0])  # the context is half its length
        _bare(axes, (-X_LIMIT - 0.4, X_LIMIT + 0.4), (-0.5, 2.3))
        axes.axhline(0.0, color=_INK, lw=1.0)
        for x in (-X_LIMIT, X_LIMIT):
            axes.plot([x, x], [-0.15, 0.15], color=_BAD, lw=2.0)
        cart = Rectangle((0.0, -0.1), 0.5, 0.2, color=_INK, lw=0)
        axes.add_patch(cart)
        fan = [axes.plot([], [], color=_PALE, lw=1.0, linestyle="--")[0] for _ in range(2)]
        (rod,) = axes.plot([], [], color=_PATH, lw=5.0, solid_capstyle="round")

        def show(observations: NDArray[Any]) -> Sequence[Artist]:
            x, angle = float(observations[-1, 0]), float(observations[-1, 2])
            cart.set_x(x - 0.25)
            for line, side in zip(fan, (-1, 1), strict=True):
                line.set_data([x, x + side * pole * math.sin(ANGLE_LIMIT)], [0.1, 0.1 + pole * math.cos(ANGLE_LIMIT)])
            rod.set_data([x, x + pole * math.sin(angle)], [0.1, 0.1 + pole * math.cos(angle)])
            fallen = abs(x) > X_LIMIT or abs(angle) > ANGLE_LIMIT
            rod.set_color(_BAD if fallen else _PATH)
            return *fan, cart, rod

        return show

    def order(self, contexts: NDArray[np.float64]) -> list[int]:
        return _spread(np.argsort(contexts[:, 0], kind="stable"))

    def caption(self, episode: Episode) -> str:
        return f"half the pole's length {episode.context[0]:.2f}"


class _GoalMaze:
    milliseconds, height, whole = 50, 4.4, True

    def prepare(self, axes: Axes, context: NDArray[np.float64]) -> Callable[[NDArray[Any]], Sequence[Artist]]:
        goal_x, goal_y, tolerance = context
        _bare(axes, (-WALL - 2, WALL + 2), (-WALL - 2, WALL + 2))
        axes.set_facecolor(_INK)
        axes.add_patch(Rectangle((-WALL, -WALL), 2 * WALL, 2 * WALL, color="white", lw=0))
        axes.add_patch(Rectangle((-BLOCK, -BLOCK), 2 * BLOCK, 2 * BLOCK, color=_INK, lw=0))
        axes.add_patch(Circle((goal_x, goal_y), tolerance, color=_GOOD, alpha=0.35, lw=0))
        axes.plot(goal_x, goal_y, marker="+", color=_GOOD, markersize=7)
        (path,) = axes.plot([], [], color=_PATH, lw=1.2)
        (walker,) = axes.plot([], [], marker="o", color=_PATH, markersize=4.5, linestyle="none")

        def show(observations: NDArray[Any]) -> Sequence[Artist]:
            path.set_data(observations[:, 0], observations[:, 1])
            walker.set_data(observations[-1:, 0], observations[-1:, 1])
            return path, walker

        return show

    def order(self, contexts: NDArray[np.float64]) -> list[int]:
        """From the least tolerance to the greatest, and where it is the same, from left to right."""
        return _spread(np.lexsort((contexts[:, 0], contexts[:, 2])))

    def caption(self, episode: Episode) -> str:
        goal_x, goal_y, tolerance = episode.context
        return f"goal ({goal_x:.1f}, {goal_y:.1f}), tolerance {tolerance:.2g}"


_SIDES: Final = np.array(  # of a cell around (0, 0), by action: from where to where
    [[(-0.5, -0.5), (0.5, -0.5)], [(-0.5, 0.5), (0.5, 0.5)], [(0.5, -0.5), (0.5, 0.5)], [(-0.5, -0.5), (-0.5, 0.5)]]
)


class _Maze:
    milliseconds, height, whole = 250, 4.4, True

    def prepare(self, axes: Axes, context: NDArray[np.float64]) -> Callable[[NDArray[Any]], Sequence[Artist]]:
        layout = self._layout(context)
        cells = layout.shape[1]
        side = math.isqrt(cells)
        _bare(axes, (-0.6, side - 0.4), (side - 0.4, -0.6), framed=False)  # y points down
        for place, colour in (((0, 0), _PALE), ((side - 1, side - 1), _GOOD)):
            axes.add_patch(Rectangle((place[0] - 0.5, place[1] - 0.5), 1, 1, color=colour, alpha=0.35, lw=0))
        closed = successors(layout)[0] == np.arange(cells)[:, None]
        walls = [_SIDES[action] + (cell % side, cell // side) for cell, action in np.argwhere(closed)]
        axes.add_collection(LineCollection(walls, colors=_INK, linewidths=1.4, capstyle="round"))
        (path,) = axes.plot([], [], color=_PATH, lw=1.6, alpha=0.7)
        (walker,) = axes.plot([], [], marker="o", color=_PATH, markersize=6, linestyle="none")

        def show(observations: NDArray[Any]) -> Sequence[Artist]:
            path.set_data(observations[:, 0], observations[:, 1])
            walker.set_data(observations[-1:, 0], observations[-1:, 1])
            return path, walker

        return show

    def order(self, contexts: NDArray[np.float64]) -> list[int]:
        """From the shortest way to the longest."""
        best = [shortest_ways(self._layout(context))[0] for context in contexts]
        return _spread(np.argsort(best, kind="stable"))

    def caption(self, episode: Episode) -> str:
        best = shortest_ways(self._layout(episode.context))[0]
        return f"{episode.length} moves, " + (f"best {best:.0f}" if np.isfinite(best) else "no way")

    def _layout(self, context: NDArray[np.float64]) -> NDArray[np.float64]:
        """`(1, cells)`."""
        return context[None]


class _MixedMaze(_Maze):
    def _layout(self, context: NDArray[np.float64]) -> NDArray[np.float64]:
        return cut_out(context[None, 1:], int(context[0]))


_SCENES: Final[Mapping[str, Scene]] = {
    "space_dist/PointMass-v0": _PointMass(),
    "space_dist/SparsePointMass-v0": _PointMass(),
    "space_dist/GoalMaze-v0": _GoalMaze(),
    "space_dist/CartPole-v0": _CartPole(),
    "space_dist/Maze-v0": _Maze(),
    "space_dist/MixedMaze-v0": _MixedMaze(),
}


def _spread(places: NDArray[np.int64]) -> list[int]:
    """At most `PANELS` squared of them, evenly from first to last."""
    count = min(len(places), PANELS**2)
    return [int(places[round(place)]) for place in np.linspace(0, len(places) - 1, count)]


def _bare(axes: Axes, x: tuple[float, float], y: tuple[float, float], *, framed: bool = True) -> None:
    axes.set(xlim=x, ylim=y, aspect="equal", xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set(color=_PALE, visible=framed)


# ---- pictures -------------------------------------------------------------------------------------------------------


def _animation(scene: Scene, episode: Episode, every: int) -> list[Image.Image]:
    """Pictures of the start, of every so many steps and of the end. What stands still is drawn once."""
    figure = Figure(figsize=(4.0, scene.height), layout="constrained", facecolor="white")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots()
    axes.set_title(f"{episode.split} {episode.id}: {scene.caption(episode)}", fontsize=9)
    axes.set_xlabel(" ", fontsize=9)  # room for the line below
    show = scene.prepare(axes, episode.context)
    line = figure.text(0.5, 0.02, "", ha="center", va="bottom", fontsize=9, color=_INK)
    moving: list[Artist] = [*show(episode.observations[:1]), line]
    for artist in moving:
        artist.set_animated(True)
    canvas.draw()  # type: ignore[no-untyped-call]
    background = canvas.copy_from_bbox(figure.bbox)  # type: ignore[no-untyped-call]
    pictures: list[Image.Image] = []
    for step in sorted({*range(0, episode.length, every), episode.length}):
        show(episode.observations[: step + 1])
        over = step == episode.length
        line.set_text(f"step {step}: {episode.outcome}" if over else f"step {step}")
        line.set_color((_BAD if episode.success is False else _GOOD) if over else _INK)
        canvas.restore_region(background)  # type: ignore[no-untyped-call]
        for artist in moving:
            figure.draw_artist(artist)
        pixels = np.array(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
        pictures.append(Image.fromarray(pixels[:, :, :3]))
    return pictures


def _labelled(frame: Frame, episode: Episode, step: int) -> Image.Image:
    """An environment's own picture, with a line of ours below."""
    height, width = frame.shape[:2]
    over = step == episode.length
    picture = Image.new("RGB", (width, height + 18), "white")
    picture.paste(Image.fromarray(frame))
    text = f"{episode.split} {episode.id}, step {step}" + (f": {episode.outcome}" if over else "")
    colour = (_BAD if episode.success is False else _GOOD) if over else _INK
    ImageDraw.Draw(picture).text((4, height + 2), text, fill=colour, font=ImageFont.load_default(size=12))
    return picture


def _stride(frames: int) -> int:
    return max(1, math.ceil(frames / MAX_FRAMES))


def _write_gif(path: Path, pictures: Sequence[Image.Image], milliseconds: int) -> None:
    """One palette for all pictures, from the first and the last: finding one for each would take most of the time."""
    width, height = pictures[0].size
    both = Image.new("RGB", (width, 2 * height))
    both.paste(pictures[0])
    both.paste(pictures[-1], (0, height))
    palette = both.quantize(256)
    first, *others = (picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures)
    durations = [max(20, milliseconds)] * len(others) + [END_MILLISECONDS]  # viewers slow down what is faster
    buffer = io.BytesIO()
    first.save(buffer, "GIF", save_all=True, append_images=others, duration=durations, loop=0)
    atomic_write(path, buffer.getvalue())


def _ranges(ids: NDArray[np.int64]) -> str:
    """Ids as people write them: 0-99."""
    if len(ids) == ids[-1] - ids[0] + 1 > 1:
        return f"{ids[0]}-{ids[-1]}"
    shown = ", ".join(map(str, ids[:10].tolist()))
    return shown if len(ids) <= 10 else f"{shown}, ..."
