"""Event sequences for the screen: a twisted blade with a broken tip corner, in every phase of a part."""

import numpy as np
from numpy.typing import NDArray

from station import events

AT = "2026-11-20T14:02:11Z"
LENGTH_MM, CHORD_MM = 105.0, 45.0


def airfoil(count: int = 480) -> NDArray[np.float64]:
    """A closed counter-clockwise section (m, 2) from the trailing edge, a cambered ellipse-like shape."""
    t = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    x = CHORD_MM / 2.0 * np.cos(t)
    thickness = 2.6 * np.sin(t) * np.sqrt(1.0 - 0.45 * np.cos(t))
    camber = 5.0 * (1.0 - (2.0 * x / CHORD_MM) ** 2)
    return np.column_stack([x, camber + thickness - 3.0])


def blade_points(count: int, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points (n, 3) and deviations (n,) of a blade whose tip corner is gone and whose side has a dent."""
    rng = np.random.default_rng(seed)
    section = airfoil()
    index = rng.integers(0, len(section), count)
    z = rng.uniform(5.0, LENGTH_MM, count)
    turn = np.deg2rad(25.0 * z / LENGTH_MM)
    x, y = section[index].T * (1.0 - 0.12 * z / LENGTH_MM)
    points = np.column_stack([x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn), z])
    along = section[index, 0]
    dent = np.exp(-(((along - 2.0) / 6.0) ** 2) - ((z - 48.0) / 7.0) ** 2) * (index > len(section) // 2)
    deviation = 0.012 * rng.standard_normal(count) + 0.05 * np.sin(z / 18.0) - 0.4 * dent
    keep = z < 88.0 + 0.5 * (CHORD_MM / 2.0 - along) + 0.8 * np.sin(along)
    return points[keep], deviation[keep]


def section_event(z_mm: float, status: str, seed: int) -> events.SectionMeasured:
    rng = np.random.default_rng(seed)
    curve = airfoil()
    tangent = np.roll(curve, -1, axis=0) - np.roll(curve, 1, axis=0)
    normal = np.column_stack([tangent[:, 1], -tangent[:, 0]])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    arc = np.linspace(0.0, 1.0, len(curve))
    deviation = (
        0.06 * np.sin(9.0 * arc)
        - 0.3 * np.exp(-(((arc - 0.42) / 0.03) ** 2))
        + 0.004 * rng.standard_normal(len(arc))
    )
    seen = np.ones(len(arc), dtype=bool) if status == "measured" else (arc > 0.06) & (arc < 0.93)
    values = (
        events.Value(name="position_mm", value=0.031, sigma=0.0011, unit="mm", nominal=0.0),
        events.Value(name="orientation_deg", value=0.12, sigma=0.004, unit="deg", nominal=0.0),
        events.Value(name="chord_mm", value=44.932, sigma=0.004, unit="mm", nominal=45.0),
        events.Value(name="max_thickness_mm", value=5.21, sigma=0.002, unit="mm", nominal=5.2),
        events.Value(
            name="te_radius_mm", value=None, sigma=None, unit="mm", nominal=0.45, reason="in a damage"
        ),
    )
    return events.SectionMeasured(
        z_mm=z_mm,
        status=status,
        nominal_mm=events.pack(curve),
        profile_mm=events.pack((curve + normal * deviation[:, None])[seen]),
        deviation_mm=events.pack(deviation[seen]),
        run=events.pack(np.zeros(int(seen.sum()))),
        le_mm=(-CHORD_MM / 2.0, -3.0),
        te_mm=(CHORD_MM / 2.0, -3.0),
        serviceable_mm=0.2,
        repairable_mm=0.8,
        values=values,
    )


def finding(name: str, deviation: float, outcome: str, serviceable: float = 0.2) -> events.FindingRow:
    return events.FindingRow(
        characteristic=name,
        value=deviation,
        deviation=deviation,
        U=0.02,
        serviceable=serviceable,
        repairable=4.0 * serviceable,
        outcome=outcome,
    )


def ready() -> list[events.Event]:
    """A cell that waits for the PLC."""
    status = events.StationStatus(
        state="IDLE", mode="SIMULATION", packml=4, station_id="CELL-1", version="0.1.0"
    )
    devices = [("turntable", "READY", "0.00 deg"), ("scanner", "READY", "93111"), ("plc", "READY", "alive")]
    devices += [("worker", "READY", "warm"), ("record", "READY", "12 parts")]
    return [
        status,
        *(events.DeviceStatus(device=d, state=s, detail=t) for d, s, t in devices),  # type: ignore[arg-type]
        events.Handshake(
            plc_bits=("ENABLE", "PART_PRESENT"),
            station_bits=("ONLINE", "READY", "SAFE_TO_UNLOAD"),
            sequence=1041,
            plc_heartbeat=7112,
            station_heartbeat=5120,
            plc_alive=True,
        ),
        events.SnapshotEnd(),
    ]


def scanning(views: int = 7) -> list[events.Event]:
    """`views` of twelve captured."""
    started = events.PartStarted(
        serial="HPC-004417", sequence=1042, recipe=1, part_number="HPC-R3", views=12, record_no=13, at_utc=AT
    )
    busy = events.Handshake(
        plc_bits=("ENABLE", "PART_PRESENT", "START"),
        station_bits=("ONLINE", "START_ACK", "BUSY"),
        sequence=1042,
        plc_heartbeat=7130,
        station_heartbeat=5138,
        plc_alive=True,
    )
    sequence: list[events.Event] = [
        *ready(),
        events.StationStatus(
            state="EXECUTE", mode="SIMULATION", packml=6, station_id="CELL-1", version="0.1.0"
        ),
        events.DeviceStatus(device="turntable", state="BUSY", detail="180.00 deg"),
        busy,
        started,
        events.StepStarted(step="scan"),
    ]
    for index in range(views):
        points, _ = blade_points(3000, index)
        sequence.append(
            events.ViewCaptured(
                index=index, total=12, angle_deg=30.0 * index, points=61204, sample_mm=events.pack(points)
            )
        )
    return sequence


def judged(verdict: str, reasons: tuple[str, ...], route: str | None) -> list[events.Event]:
    """The whole part, with this verdict."""
    points, deviation = blade_points(26_000, 99)
    cloud = events.CloudMeasured(
        points_mm=events.pack(points),
        deviation_mm=events.pack(deviation),
        serviceable_mm=0.2,
        repairable_mm=0.8,
    )
    durations = {
        "scan": 9.7, "clean": 1.1, "register": 2.3, "sections": 1.2, "twin": 5.1,
        "damage": 0.9, "repair": 2.2, "judge": 0.0, "record": 0.1,
    }  # fmt: skip
    done = [events.StepFinished(step=name, duration_s=seconds) for name, seconds in durations.items()]
    bad = {"PASS": "PASS", "REPAIR": "REPAIR", "SCRAP": "SCRAP", "HOLD": "HOLD"}[verdict]
    findings = (
        finding("damage.tip.depth_mm", 8.21, bad, 0.5),
        finding("sections[98.0].profile_min_mm", -0.31, "NOT_JUDGED"),
        finding("sections[52.5].profile_min_mm", -0.18, "PASS"),
        finding("sections[52.5].chord_mm", -0.068, "PASS", 0.6),
        finding("sections[7.0].position_mm", 0.031, "PASS", 0.15),
        finding("sections[7.0].orientation_deg", 0.12, "PASS", 0.4),
        finding("form.deviation_mm", 0.11, "PASS", 0.25),
    )
    reached = events.VerdictReached(
        serial="HPC-004417",
        sequence=1042,
        part_number="HPC-R3",
        verdict=verdict,  # type: ignore[arg-type]
        route=route,
        reasons=reasons,
        findings=findings,
        record_no=13,
        durations_s=durations,
        simulated=True,
        at_utc=AT,
    )
    recorded = events.PartRecorded(
        record_no=13,
        serial="HPC-004417",
        sequence=1042,
        verdict=verdict,
        reason=reasons[0],
        acknowledged=False,
        at_utc=AT,  # type: ignore[arg-type]
    )
    sections = [
        section_event(7.0, "measured", 1),
        section_event(52.5, "measured", 2),
        section_event(98.0, "in_damage", 3),
    ]
    return [*scanning(12), *done, *sections, cloud, reached, recorded]


def alarm(number: int = 101, state: str = "UNACK") -> events.AlarmRaised:
    return events.AlarmRaised(
        number=number,
        priority=2,
        text="TURNTABLE NOT RESPONDING on /dev/ttyUSB0",
        action="check cable and power, then F9 reset",
        state=state,  # type: ignore[arg-type]
        first_out=True,
        at_utc=AT,
    )


SCENES = {
    "ready": ready,
    "scanning": scanning,
    "repair": lambda: judged("REPAIR", ("tip: depth 8.21 mm > serviceable 0.50 mm",), "fill"),
    "pass": lambda: judged("PASS", ("every value inside its serviceable limit",), None),
    "scrap": lambda: judged("SCRAP", ("tip: depth 18.40 mm > repairable 15.00 mm",), None),
    "hold": lambda: [*judged("HOLD", ("surface: 3.1 mm gap unseen at z 61 mm",), None), alarm()],
}
