"""The states of the station and the transition table; the table is the machine.

A trigger that is not in the table for the present state is refused: `after` returns None, the caller
logs it and nothing changes. Which of these states the PLC sees as which number: `PACKML`.

    inner state   handshake (docs/wire/plc.md)      register 103 (PackML, TR88 numbers)
    BOOT          OFFLINE                            9  Aborted
    ABORTED       FAULT                              9  Aborted
    CLEARING      FAULT                              1  Clearing
    STOPPED       OFFLINE                            2  Stopped
    RESETTING     OFFLINE                           15  Resetting
    IDLE          IDLE                               4  Idle
    SUSPENDED     IDLE, PLC_LOST                     5  Suspended
    EXECUTE       MEASURING                          6  Execute
    COMPLETING    PUBLISHED                         16  Completing
    COMPLETE      CLEARING, ABORTED (interrupted)   17  Complete
    STOPPING      OFFLINE                            7  Stopping
    ABORTING      FAULT                              8  Aborting

A verdict that is already published stays published in every state until it is acknowledged.
"""

from enum import StrEnum


class State(StrEnum):
    BOOT = "BOOT"
    ABORTED = "ABORTED"
    CLEARING = "CLEARING"
    STOPPED = "STOPPED"
    RESETTING = "RESETTING"
    IDLE = "IDLE"
    SUSPENDED = "SUSPENDED"
    EXECUTE = "EXECUTE"
    COMPLETING = "COMPLETING"
    COMPLETE = "COMPLETE"
    STOPPING = "STOPPING"
    ABORTING = "ABORTING"


class Trigger(StrEnum):
    CHECKED = "CHECKED"  # start-up checks and recovery are done
    START = "START"
    READY = "READY"  # connected, identified, homed
    REQUEST = "REQUEST"  # durable: the request is in the record
    PUBLISHED = "PUBLISHED"  # a verdict stands in the registers
    INTERRUPTED = "INTERRUPTED"  # the request ended without a verdict
    ACKED = "ACKED"
    RELEASED = "RELEASED"  # the PLC has dropped START and RESULT_ACK
    PLC_LOST = "PLC_LOST"
    PLC_BACK = "PLC_BACK"
    STOP = "STOP"
    STOPPED = "STOPPED"
    FAULT = "FAULT"
    SAFE = "SAFE"  # motion stopped, or its stop given up
    RESET = "RESET"
    CLEARED = "CLEARED"


_RUNNING = (
    State.RESETTING,
    State.IDLE,
    State.SUSPENDED,
    State.EXECUTE,
    State.COMPLETING,
    State.COMPLETE,
)

TABLE: dict[tuple[State, Trigger], State] = {
    (State.BOOT, Trigger.CHECKED): State.STOPPED,
    (State.BOOT, Trigger.FAULT): State.ABORTED,
    (State.STOPPED, Trigger.START): State.RESETTING,
    (State.RESETTING, Trigger.READY): State.IDLE,
    (State.IDLE, Trigger.REQUEST): State.EXECUTE,
    (State.IDLE, Trigger.PUBLISHED): State.COMPLETING,
    (State.IDLE, Trigger.PLC_LOST): State.SUSPENDED,
    (State.SUSPENDED, Trigger.PLC_BACK): State.IDLE,
    (State.EXECUTE, Trigger.PUBLISHED): State.COMPLETING,
    (State.EXECUTE, Trigger.INTERRUPTED): State.COMPLETE,
    (State.COMPLETING, Trigger.ACKED): State.COMPLETE,
    (State.COMPLETE, Trigger.RELEASED): State.IDLE,
    (State.STOPPING, Trigger.STOPPED): State.STOPPED,
    (State.ABORTING, Trigger.SAFE): State.ABORTED,
    (State.ABORTED, Trigger.RESET): State.CLEARING,
    (State.CLEARING, Trigger.CLEARED): State.STOPPED,
    **{(state, Trigger.STOP): State.STOPPING for state in _RUNNING},
    **{
        (state, Trigger.FAULT): State.ABORTING
        for state in (*_RUNNING, State.STOPPED, State.STOPPING, State.CLEARING)
    },
}

PACKML: dict[State, int] = {
    State.BOOT: 9,
    State.CLEARING: 1,
    State.STOPPED: 2,
    State.IDLE: 4,
    State.SUSPENDED: 5,
    State.EXECUTE: 6,
    State.STOPPING: 7,
    State.ABORTING: 8,
    State.ABORTED: 9,
    State.RESETTING: 15,
    State.COMPLETING: 16,
    State.COMPLETE: 17,
}

FAULTED = frozenset({State.BOOT, State.ABORTING, State.ABORTED, State.CLEARING})


def after(state: State, trigger: Trigger) -> State | None:
    """The next state, or None when the table refuses `trigger` in `state`."""
    return TABLE.get((state, trigger))
