"""The watch over a service: its health line, systemd's watchdog, the system's clock.

A thread looks once a second, or more often for a watchdog. It tells systemd that the service is
alive only while frames are finished, or while the camera is waited for and its reader is at work: a
loop that hangs is found, whatever it hangs in.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from threading import Event, Thread

from cvo_edge.estimate import PoseInterval
from cvo_edge.input.clock import SYSTEM_CLOCK, Clock
from cvo_edge.input.followed import FollowedFolder
from cvo_edge.input.sources import Camera
from cvo_edge.input.waiting import Waiting
from cvo_edge.output.dropping import Dropping
from cvo_edge.output.metrics import Count
from cvo_edge.output.opening import Writing
from cvo_edge.programs.job import Job, Opening
from cvo_edge.programs.measure import LatencyProfile, memory_mib
from cvo_edge.programs.notify import Notifier
from cvo_edge.record import Status

PERIOD_S = 1.0
# A watch that comes so much later than it was asked for did not run: the process was stopped.
_STOOD_S = 2.0
# The system's time is slewed by 0.5 ms a second at most.
_STEP_S = 0.25
# Without a watchdog, a frame in work for longer is said.
_STUCK_S = 30.0
# Latencies that a health line looks at.
_RECENT = 4096


class Service:
    """Counts what a job does, and watches it.

    Parameters
    ----------
    waiting
        What the job's camera was opened with.
    notifier
        Speaks to systemd.
    told
        Called with each line that a user should read.
    every_s
        Seconds between health lines.
    """

    def __init__(
        self,
        waiting: Waiting,
        notifier: Notifier,
        told: Callable[[str], None],
        every_s: float,
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        self.sinks: list[Dropping] = []
        self._waiting, self._notifier, self._told = waiting, notifier, told
        self._clock, self._every_s = clock, every_s
        limit_s = notifier.watchdog_s
        self.period_s = PERIOD_S if limit_s is None else min(PERIOD_S, limit_s / 4)
        self._limit_s = limit_s or _STUCK_S
        self._job: Job | None = None
        self._recent = LatencyProfile(("total",), _RECENT)
        self._begin_s = self._looked_s = self._health_s = clock.now_s()
        self._calm_s = self._resumed_s = clock.awake_s()
        self._day_s, _ = self._day()
        self._done = self._frames_then = 0
        self._stuck = False
        self._ended = Event()
        self._watch = Thread(target=self._look_on, name="cvo-edge watch", daemon=True)

    def around(self, what: str, opening: Opening) -> AbstractContextManager[Writing]:
        """Return a sink that outlives a full disk, and counts; figures need no disk."""
        if what == "metrics":
            return opening()
        self.sinks.append(Dropping(what, opening, self._told))
        return self.sinks[-1]

    def start(self, job: Job) -> None:
        """Watch a job that is open."""
        self._job = job
        self._calm_s = self._clock.awake_s()
        self._notifier.ready("waiting for the first frame")
        self._watch.start()

    def end(self) -> None:
        """Watch no longer."""
        self._ended.set()
        if self._watch.is_alive():
            self._watch.join()

    def write(self, estimate: PoseInterval) -> None:
        """Write an estimate to the job's sinks."""
        if self._job is not None:
            self._job.write(estimate)
        self._recent.add(estimate.latency_ms)

    # -- accounts ---------------------------------------------------------------------------------

    def figures(self) -> dict[str, float | str]:
        """Return the account of all frames.

        ``delivered`` = ``frames`` + ``dropped_frames`` + ``pending``; ``frames`` = ``records`` +
        ``dropped_records``.
        """
        job = self._job
        if job is None:
            return {}
        summary, camera = job.summary, _camera(job)
        done = summary.frames + summary.dropped
        delivered = done if camera is None else camera.delivered
        found: dict[str, float | str] = {
            "delivered": delivered,
            "frames": summary.frames,
            **{status.value: summary.statuses[status] for status in Status},
            "dropped_frames": summary.dropped,
            "pending": max(0, delivered - done),
        }
        for sink in self.sinks:
            found[sink.what] = sink.written
            found[f"dropped_{sink.what}"] = sink.dropped
        found["reopened"] = self._waiting.reopened
        if camera is not None:
            found["camera"] = "lost" if self._waiting.lost else "up"
        return found

    def counts(self) -> list[Count]:
        """Return the figures that the metrics have beside those of the frames."""
        figures = self.figures()
        found = [
            Count(f"cvo_{name}", text, float(figures[key]))
            for name, key, text in (
                ("delivered_frames", "delivered", "Frames that the camera gave."),
                ("records", "records", "Records written."),
                ("dropped_records", "dropped_records", "Records that could not be written."),
                ("camera_reopened", "reopened", "How often a lost camera came back."),
            )
            if key in figures
        ]
        lost = float(figures.get("camera") == "lost")
        return [
            *found,
            Count("cvo_camera_lost", "1 while the camera gives no frames.", lost, False),
            Count("cvo_stuck", "1 while the watchdog is not fed.", float(self._stuck), False),
        ]

    def health(self) -> str:
        """Return the health line; latencies and rate are those since the last one."""
        now, job = self._clock.now_s(), self._job
        recent, self._recent = self._recent, LatencyProfile(("total",), _RECENT)
        frames = 0 if job is None else job.summary.frames
        rate = (frames - self._frames_then) / max(now - self._health_s, 1e-9)
        self._frames_then, self._health_s = frames, now
        latency = recent.summary().get("total", {})
        words: dict[str, float | str] = {
            "uptime_s": round(now - self._begin_s),
            "fps": f"{rate:.1f}",
            **self.figures(),
            "p50_ms": f"{latency['p50']:.1f}" if latency else "none",
            "p99_ms": f"{latency['p99']:.1f}" if latency else "none",
            "peak_mib": round(memory_mib()["peak_rss"]),
        }
        return "health: " + " ".join(f"{key}={value}" for key, value in words.items())

    def lines(self) -> list[str]:
        """Return the account as lines of the summary."""
        figures = self.figures()
        lines = [
            f"account     {figures['delivered']} frames delivered = {figures['frames']} estimated"
            f" + {figures['dropped_frames']} dropped for newer ones"
        ]
        if figures["pending"]:
            lines[0] += f" + {figures['pending']} unfinished"
        lines += [
            f"{sink.what:<11} {sink.written} written, {sink.dropped} dropped" for sink in self.sinks
        ]
        if self._waiting.reopened:
            lines.append(f"camera      came back {self._waiting.reopened} times")
        return lines

    def say_health(self) -> None:
        """Say the health line now."""
        self._told(self.health())

    # -- the watch --------------------------------------------------------------------------------

    def _look_on(self) -> None:
        while not self._clock.wait(self._ended, self.period_s):
            self.look()

    def look(self) -> None:
        """Look once, as the thread does in every period."""
        stood = self._stood_still()
        self._follow_the_clock()
        if self._is_alive(stood):
            self._notifier.alive()
        if self._clock.now_s() - self._health_s >= self._every_s:
            self.say_health()

    def _day(self) -> tuple[float, float]:
        """Return the time of day at which the steady clock began, and its uncertainty, s."""
        begin_s, day_s, end_s = (
            self._clock.now_s(),
            1e-9 * self._clock.time_ns(),
            self._clock.now_s(),
        )
        return day_s - begin_s, end_s - begin_s

    def _stood_still(self) -> bool:
        """Tell whether this process did not run since the last look, and say so."""
        now = self._clock.now_s()
        gap_s, self._looked_s = now - self._looked_s, now
        if gap_s < self.period_s + _STOOD_S:
            return False
        self._told(f"stood still: this process did not run for {gap_s:.1f} s; old frames are stale")
        return True

    def _follow_the_clock(self) -> None:
        day_s, doubt_s = self._day()
        step_s = day_s - self._day_s
        # On a busy machine, the clocks may be read long after each other.
        if abs(step_s) < _STEP_S + doubt_s:
            return
        self._day_s += step_s
        way = "forward" if step_s > 0 else "back"
        self._told(f"clock stepped: the system's time was set {way} by {abs(step_s):.1f} s")

    def _is_alive(self, stood: bool) -> bool:
        """Whether frames are finished, or the camera is waited for and its reader works."""
        job, now = self._job, self._clock.awake_s()
        if job is None:
            return True
        done, camera = job.summary.frames + job.summary.dropped, _camera(job)
        idle = camera is not None and camera.delivered == done
        if stood:
            self._resumed_s = now
        if stood or idle or done != self._done:
            self._calm_s = now
        self._done = done
        alive = now - self._calm_s <= self._limit_s
        if idle and camera is not None:
            alive = now - max(camera.heard_s, self._resumed_s) <= camera.longest_silence_s
        if not alive and not self._stuck:
            self._told("stuck: no frame was finished, and the camera is not waited for")
        self._stuck = not alive
        return alive


def _camera(job: Job) -> Camera | FollowedFolder | None:
    return job.frames if isinstance(job.frames, Camera | FollowedFolder) else None
