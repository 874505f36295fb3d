"""Where an axis is at any time of a motion; positions in microsteps, speeds in microsteps/s."""

from dataclasses import dataclass
from math import copysign, sqrt


@dataclass(frozen=True, slots=True, kw_only=True)
class Segment:
    """A stretch of constant acceleration."""

    duration_s: float
    acceleration: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """From a position and speed at `start_s`, segment by segment, then on at `last_speed` from `last`."""

    start_s: float
    position: float
    last: float
    speed: float = 0.0
    last_speed: float = 0.0
    segments: tuple[Segment, ...] = ()

    def at(self, now_s: float) -> tuple[float, float]:
        """Position and speed, in microsteps and microsteps/s."""
        if now_s >= self.end_s:
            return self.last + self.last_speed * (now_s - self.end_s), self.last_speed
        return _travel(self.position, self.speed, self.segments, now_s - self.start_s)

    @property
    def end_s(self) -> float:
        """When the last segment ends."""
        return self.start_s + sum(segment.duration_s for segment in self.segments)


def rest(now_s: float, position: float) -> Motion:
    """Standing still."""
    return Motion(start_s=now_s, position=position, last=position)


def move_to(now_s: float, here: float, speed: float, target: float, top: float, rate: float) -> Motion:
    """The quickest motion from `here` at `speed` to rest at `target`, within `top` speed and `rate`."""
    stop = here + speed * abs(speed) / (2.0 * rate)
    side = copysign(1.0, target - stop)
    entry, way = side * speed, side * (target - here)
    # Peak of the triangle that covers the way; a flat top where that would be too fast.
    peak = min(sqrt(max(rate * way + 0.5 * entry * entry, 0.0)), top)
    first = copysign(rate, peak - entry)
    ramps = (peak * peak - entry * entry) / (2.0 * first) + peak * peak / (2.0 * rate)
    segments = (
        Segment(duration_s=abs(peak - entry) / rate, acceleration=side * first),
        Segment(duration_s=max(way - ramps, 0.0) / peak if peak > 0.0 else 0.0, acceleration=0.0),
        Segment(duration_s=peak / rate, acceleration=-side * rate),
    )
    return Motion(start_s=now_s, position=here, speed=speed, segments=segments, last=target)


def change_speed(now_s: float, here: float, speed: float, target: float, rate: float) -> Motion:
    """The motion that goes over from `speed` to the speed `target` and keeps it."""
    ramp = Segment(duration_s=abs(target - speed) / rate, acceleration=copysign(rate, target - speed))
    last, _ = _travel(here, speed, (ramp,), ramp.duration_s)
    return Motion(
        start_s=now_s, position=here, speed=speed, segments=(ramp,), last=last, last_speed=float(target)
    )


def _travel(
    position: float, speed: float, segments: tuple[Segment, ...], left_s: float
) -> tuple[float, float]:
    """Position and speed after `left_s` on these segments."""
    for segment in segments:
        dt_s = min(segment.duration_s, max(left_s, 0.0))
        position += speed * dt_s + 0.5 * segment.acceleration * dt_s * dt_s
        speed += segment.acceleration * dt_s
        left_s -= dt_s
    return position, speed
