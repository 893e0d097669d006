"""Logs replayed into a scene, and what happened in them: before and after, or estimators side by side."""

from collections.abc import Callable, Sequence

import rerun as rr

from companion.config import Config
from companion.errors import UserError
from companion.events import Event, worst_error
from companion.log import Log, RawChunk, Truth
from companion.pipeline import Tick
from companion.replay import Replay, replay
from companion.run_folder import log_name
from companion.view.blueprint import REVIEW_TRAIL, comparison_blueprint, run_blueprint
from companion.view.files import BATCH
from companion.view.scene import Scene
from estimators.immutable import immutable

ROOTS = ("before", "after")
"""Of two logs."""


@immutable
class Span:
    """The part of a log that is shown, in seconds since its start; `end` None = all the rest.

    Estimators always run from the start: their state at the beginning of a part comes from what was before.
    """

    begin: float = 0.0
    end: float | None = None


@immutable
class Review:
    """What was found in one log.

    Attributes:
        log: that was read.
        result: of the replay.
        events: in the part that is shown, in the order of time.
    """

    log: Log
    result: Replay
    events: list[Event]


def review(
    logs: Sequence[tuple[Log, Config]],
    names: Sequence[str] | None,
    span: Span,
    stream: rr.RecordingStream,
    on_progress: Callable[[float], None],
) -> list[Review]:
    """Replay logs into a stream of Rerun, which shows them as they come.

    Args:
        logs: one, or two to be compared, each with its configuration.
        names: estimators side by side, the primary first; None for each log's own.
        span: part that is shown.
        stream: to draw into.
        on_progress: told the share that is done.

    Raises:
        UserError: the part is empty, or a log holds no bytes of a sensor of its site.
    """
    scenes: list[Scene] = []
    reviews = []

    def arrange() -> None:
        layouts = [scene.layout() for scene in scenes]
        compares = len(scenes[0].layout().names) > 1
        blueprint = (
            run_blueprint(layouts[0], REVIEW_TRAIL, compares)
            if len(logs) == 1
            else comparison_blueprint(layouts)
        )
        stream.send_blueprint(blueprint)

    for i, (log, config) in enumerate(logs):
        chosen = list(names or [config.pipeline.estimator])
        root, title = (f"{ROOTS[i]}/", f"{ROOTS[i]} {log_name(log.path)}") if len(logs) > 1 else ("", "")
        scene = Scene(config, chosen, stream, log.start_ns, root, title)
        scenes.append(scene)

        def progress(share: float, before: int = i) -> None:
            on_progress((before + share) / len(logs))

        result = _replay_into(scene, log, config, chosen, span, progress, arrange)
        reviews.append(Review(log, result, _events(scene, result, log, span)))
    arrange()
    return reviews


def _replay_into(
    scene: Scene,
    log: Log,
    config: Config,
    names: list[str],
    span: Span,
    on_progress: Callable[[float], None],
    arrange: Callable[[], None],
) -> Replay:
    begin_ns = log.start_ns + round(span.begin * 1e9)
    until_ns = None if span.end is None else log.start_ns + round(span.end * 1e9)
    plots: set[str] = set()
    shown = False

    def tick(tick: Tick, truth: Truth | None) -> None:
        nonlocal plots, shown
        if tick.stamp_ns < begin_ns:
            return
        shown = True
        scene.tick(tick, truth)
        if scene.waiting >= BATCH:
            scene.send()
            # Arranged anew only when there is more to see: it would undo what the user has moved.
            if plots != (plots := set(scene.layout().plots)):
                arrange()

    def chunk(chunk: RawChunk) -> None:
        if chunk.stamp_ns >= begin_ns:
            scene.chunk(chunk)

    result = replay(log, config, names, tick, on_progress, chunk, until_ns)
    if not shown:
        raise UserError(f"--from {span.begin:g}: {log.path} ends at {result.duration:.1f} s")
    scene.close()
    return result


def _events(scene: Scene, result: Replay, log: Log, span: Span) -> list[Event]:
    events = list(scene.events)
    errors = result.errors.get(result.names[0])
    if errors is not None:
        worst = worst_error(errors, log.start_ns + round(span.begin * 1e9))
        events += [worst] if worst is not None else []
    return sorted(events, key=lambda event: event.stamp_ns)
