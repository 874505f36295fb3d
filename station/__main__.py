"""The bladecell command. Each command imports what it needs when it runs, so that `--help` is quick."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

EXIT = {"PASS": 0, "REPAIR": 10, "SCRAP": 20, "HOLD": 30}
BAD_INPUT = 2
STEPS = 14  # of an inspection, for the bar

app = typer.Typer(
    name="bladecell",
    help="Inspects damaged aero-engine blades: scan in, PASS, REPAIR, SCRAP or HOLD out.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

Config = Annotated[
    Path | None,
    typer.Option("--config", metavar="FILE", help="Default: ./config/station.toml, then the user's folder."),
]
Json = Annotated[bool, typer.Option("--json", help="Print the document on stdout and nothing else.")]
PASS_ON = {"allow_extra_args": True, "ignore_unknown_options": True}


@contextmanager
def bad_input_is_one_line() -> Iterator[None]:
    """Ends the command with status 2 and one line on stderr when its input is at fault."""
    from geometry.errors import BadInput
    from station.refusal import Refusal

    try:
        yield
    except (Refusal, BadInput) as error:
        say(str(error))
        raise typer.Exit(BAD_INPUT) from None


def say(text: str) -> None:
    """One line on stderr, whatever the text holds."""
    line = "".join(c if c.isprintable() else "?" for c in " ".join(text.split()))
    sys.stderr.write(f"bladecell: {line}\n")


@app.command()
def demo(
    *,
    headless: Annotated[bool, typer.Option("--headless", help="No screen, a fixed number of parts.")] = False,
    parts: Annotated[int | None, typer.Option(min=1, help="Parts to inspect.")] = None,
    seed: Annotated[int, typer.Option(help="Of the simulated blades.")] = 0,
) -> None:
    """A simulated cell and the station, as `make demo`."""
    from station import commands_live

    raise typer.Exit(commands_live.demo(headless=headless, parts=parts, seed=seed))


@app.command()
def run(
    *, config: Config = None, headless: Annotated[bool, typer.Option("--headless", help="No screen.")] = False
) -> None:
    """The station against the addresses in the configuration."""
    from station import commands_live

    raise typer.Exit(commands_live.run_station(config=config, headless=headless))


@app.command()
def tui(
    *,
    connect: Annotated[str | None, typer.Option(metavar="ADDR", help="HOST:PORT of a station.")] = None,
    config: Config = None,
) -> None:
    """The operator screen on a running station."""
    from station import commands_live

    raise typer.Exit(commands_live.tui(connect=connect, config=config))


@app.command()
def inspect(
    *,
    plan: Annotated[Path, typer.Option(metavar="PLAN.toml", help="The part number's plan.")],
    scan: Annotated[Path, typer.Option(metavar="FILE", help="PLY, PCD, XYZ, ASC, CSV or E57, mm.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where the result goes.")],
    serial: Annotated[str, typer.Option(metavar="SN", help="Serial number of the blade.")] = "UNKNOWN",
    json: Json = False,
) -> None:
    """One merged cloud, no devices. Exit status: 0 PASS, 10 REPAIR, 20 SCRAP, 30 HOLD."""
    import time

    from station.steps import shown

    with bad_input_is_one_line(), shown(STEPS) as progress:
        from station.inspect import inspect_scan

        done = inspect_scan(plan, scan, out, serial=serial, clock=time.perf_counter, progress=progress)
    if json:
        from station.document import document_text

        sys.stdout.write(document_text(done.result))
    else:
        sys.stdout.write(f"{summary(done.result)}\n{out / 'report.html'}\n")
    raise typer.Exit(EXIT[done.result["verdict"]])


def summary(result: dict[str, object]) -> str:
    """The verdict in one line with its first reason."""
    reasons = result["reasons"]
    first = reasons[0] if isinstance(reasons, list) and reasons else ""
    return f"{result['verdict']}{' ' + str(result['route']) if result['route'] else ''}: {first}"


@app.command()
def replay(
    jobs: Annotated[list[Path], typer.Argument(metavar="JOB...", help="Job folders.")],
    *,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Where the files of each go.")] = None,
    workers: Annotated[int, typer.Option("--jobs", min=1, help="Processes.")] = 1,
) -> None:
    """Recorded jobs measured and judged again from their raw frames."""
    from station import commands_live

    raise typer.Exit(commands_live.replay(jobs=jobs, out=out, workers=workers))


@app.command(context_settings=PASS_ON, add_help_option=False)
def synth(context: typer.Context) -> None:
    """A damaged blade with its ground truth: plan, nominal, scan, truth."""
    become("simulators.synth", *context.args)


@app.command(context_settings=PASS_ON, add_help_option=False)
def simulate(context: typer.Context) -> None:
    """The simulated cell alone, for any client."""
    become("simulators", "serve", *context.args)


def become(module: str, *arguments: str) -> None:
    """Turns this process into another of ours: signals, streams and exit status are its own.

    -P: a folder named like the module must not be run in its stead."""
    os.execv(sys.executable, [sys.executable, "-P", "-m", module, *arguments])  # noqa: S606


@app.command()
def calibrate(
    *,
    spheres: Annotated[
        Path, typer.Option(metavar="FILE.csv", help="Rows: angle_deg, x, y, z of a ball's centre [, ball].")
    ],
    out: Annotated[Path, typer.Option(metavar="FILE.toml", help="The calibration or check to write.")],
    scanner_serial: Annotated[
        int | None, typer.Option(min=0, help="Of the scanner that saw the ball, for a new calibration.")
    ] = None,
    check: Annotated[
        Path | None, typer.Option(metavar="CALIBRATION.toml", help="Check this one with a ball bar instead.")
    ] = None,
    bar_mm: Annotated[float, typer.Option(min=0.0, help="Certified distance of the bar's two balls.")] = 0.0,
) -> None:
    """The turntable's axis from a ball that rides on it; or its daily check with a ball bar."""
    from datetime import UTC, datetime

    with bad_input_is_one_line():
        from station.calibration import calibrate_from, check_from

        now = datetime.now(UTC)
        if check is not None and not bar_mm > 0.0:
            raise typer.BadParameter("--check needs --bar-mm, the certified distance of the bar's two balls")
        if check is not None:
            line = check_from(spheres, check, bar_mm, out, now)
        elif scanner_serial is not None:
            line = calibrate_from(spheres, out, scanner_serial, now)
        else:
            raise typer.BadParameter("give --scanner-serial, or --check for a daily check")
    sys.stdout.write(f"{line}\n")


@app.command()
def history(
    *, config: Config = None, json: Json = False, last: Annotated[int, typer.Option(min=1)] = 20
) -> None:
    """The last requests and their verdicts."""
    from station import commands_live

    raise typer.Exit(commands_live.history(config=config, as_json=json, last=last))


@app.command()
def export(
    *, out: Annotated[Path, typer.Option(metavar="FILE", help="CSV of all findings.")], config: Config = None
) -> None:
    """Hands the record over."""
    from station import commands_live

    raise typer.Exit(commands_live.export(config=config, out=out))


@app.command()
def verify(*, config: Config = None) -> None:
    """Proves the record: its chain and its files. Exit status 0 if and only if it holds."""
    from station import commands_live

    raise typer.Exit(commands_live.verify(config=config))


@app.command()
def doctor(
    *,
    config: Config = None,
    plan: Annotated[Path | None, typer.Option(metavar="PLAN.toml", help="Only this plan.")] = None,
) -> None:
    """Checks packages, libraries, configuration, calibration, plans and nominals."""
    from datetime import UTC, datetime

    from station.doctor import examine

    faults = 0
    for check in examine(config, plan, datetime.now(UTC)):
        faults += check.fault is not None
        sys.stdout.write(f"{'ok  ' if check.fault is None else 'BAD '} {check.what}")
        sys.stdout.write(f": {check.fault}\n" if check.fault else "\n")
    raise typer.Exit(1 if faults else 0)


def main() -> None:
    """The entry point."""
    app()


if __name__ == "__main__":
    main()
