"""The executive and the main loop of the firmware, compiled for the host, at a time that a test sets."""

import ctypes

import numpy as np

from dualbrain.safety.cbf.config import operating_config
from dualbrain.safety.target.boards import find_board
from dualbrain.safety.target.build import KERNEL_FLAGS, PROFILES, Firmware, _render_key
from dualbrain.safety.target.frames import FrameReader, decode_frame
from dualbrain.safety.target.messages import CYCLE, CYCLE_REPLY, Message, obstacle_frames, padded, parse_cycle_reply
from dualbrain.safety.target.robot_tables import render_robot_tables, robot_tables_hash
from dualbrain.safety.target.session import TargetSession
from dualbrain.safety.target.target_kernel import NO_BASE
from tests.firmware.c_library import ROOT, load_library

KEY = bytes(range(16))
PORT = """
#include <setjmp.h>
#include "executive/loop.h"
#include "port/hal.h"

static executive state;
static uint64_t time_us;
static uint8_t sent[1 << 16];
static uint32_t n_sent, n_left, n_passes;
static const uint8_t *input;
static uint32_t *refused_by_pass;
static jmp_buf idle;

void hal_init(void) {}
int hal_rx(void) { return n_left ? (--n_left, *input++) : -1; }
void hal_tx(const uint8_t *bytes, uint32_t size) {
  for (uint32_t i = 0; i < size && n_sent < sizeof sent; ++i) { sent[n_sent++] = bytes[i]; }
}
uint64_t hal_now(void) {
  if (refused_by_pass) { refused_by_pass[n_passes++] = state.refused; }
  return time_us;
}
void hal_drive_enable(int on) { (void)on; }
int hal_estop_in(void) { return 0; }
void hal_watchdog(void) {}
uint64_t hal_nonce(void) { return 7; }
void hal_wait(void) { longjmp(idle, 1); }

void port_start(void);
void port_start(void) {
  time_us = 1000000;
  n_sent = 0;
  executive_init(&state);
}

void port_receive(const uint8_t *bytes, uint32_t size);
void port_receive(const uint8_t *bytes, uint32_t size) {
  for (uint32_t i = 0; i < size; ++i) { (void)executive_receive(&state, bytes[i]); }
}

void port_wait(uint64_t us);
void port_wait(uint64_t us) {
  time_us += us;
  executive_watchdog(&state, time_us);
}

uint32_t port_take(uint8_t *to);
uint32_t port_take(uint8_t *to) {
  const uint32_t n = n_sent;
  for (uint32_t i = 0; i < n; ++i) { to[i] = sent[i]; }
  n_sent = 0;
  return n;
}

/* runs the main loop until it waits; counts the frames that were refused at each reading of the clock */
uint32_t port_loop(const uint8_t *bytes, uint32_t size, uint32_t *refused);
uint32_t port_loop(const uint8_t *bytes, uint32_t size, uint32_t *refused) {
  input = bytes;
  n_left = size;
  n_passes = 0;
  refused_by_pass = refused;
  if (!setjmp(idle)) { executive_loop(&state); }
  refused_by_pass = 0;
  return n_passes;
}
"""
"""A hardware layer without hardware, and the functions that a test calls."""


def load_firmware(folder, robot_model):
    """The firmware of a robot with its own clock, as a library of the host."""
    config = operating_config(robot_model)
    generated = {
        "robot_tables.c": render_robot_tables(robot_model, config),
        "shared_key.c": _render_key(Firmware(board=find_board("an386"), key=KEY)),
        "port.c": PORT,
    }
    for name, text in generated.items():
        (folder / name).write_text(text)
    folders = ("kernel/src", "kernel/supervisor", "firmware/executive", "firmware/protocol")
    sources = sorted(path for name in folders for path in (ROOT / name).rglob("*.c"))
    flags = (*KERNEL_FLAGS, *PROFILES["full"])
    library = load_library(folder, *sources, *(folder / name for name in generated), flags=flags)
    library.port_wait.argtypes = [ctypes.c_uint64]
    return library


def refused_by_pass(library, data):
    """The number of frames that were refused after each pass of a main loop that receives `data` until it waits."""
    refused = (ctypes.c_uint32 * (len(data) + 16))()
    return list(refused[: library.port_loop(data, len(data), refused)])


class HostedTarget:
    """A session with a firmware that has just been started, without obstacles and with the arm at home."""

    def __init__(self, library, robot_model):
        self._library, self.robot_model, self._reader = library, robot_model, FrameReader()
        self._buffer = (ctypes.c_uint8 * 65536)()
        self.now, self.period_us = 0.0, round(robot_model.period * 1e6)
        library.port_start()
        self.open()

    def open(self):
        """Open a new session, in which the host sends a scene without obstacles."""
        robot_model = self.robot_model
        self.session = TargetSession(self, KEY, robot_tables_hash(robot_model, operating_config(robot_model)))
        for kind, payload in obstacle_frames(np.zeros((0, 29)), {}):
            self.session.send(kind, payload)

    def write(self, data):
        """Send bytes to the target."""
        self._library.port_receive(data, len(data))

    def read(self, timeout):
        """The bytes that the target has sent; it answers at once."""
        del timeout
        return bytes(self._buffer[: self._library.port_take(self._buffer)])

    def wait(self, us):
        """Let the time pass, with one pass of the watchdog at its end."""
        self.now += us * 1e-6
        self._library.port_wait(us)

    def send_cycle(self, u_nom, v, conditions=0):
        """Send a CYCLE at the present time; `u_nom` and `v` are one value for all joints, or one for each."""
        n, times = self.robot_model.n, (round((1.0 + self.now) * 1e6),) * 2
        joints = (self.robot_model.home, *(np.broadcast_to(values, n).tolist() for values in (v, u_nom)))
        reals = [value for values in joints for value in padded(values)]
        self.session.send(Message.CYCLE, CYCLE.pack(*times, int(conditions), *reals, *[0.0] * 3, 1, *NO_BASE))

    def replies(self):
        """The replies and outputs since the last call, in their order."""
        frames = (decode_frame(piece, self.session._key) for piece in self._reader.feed(self.read(0.0)))
        return [parse_cycle_reply(one.payload) for one in frames if one and len(one.payload) == CYCLE_REPLY.size]

    def cycle(self, u_nom, v, conditions=0):
        """One CYCLE after one period, and its reply."""
        self.wait(self.period_us)
        self.send_cycle(u_nom, v, conditions)
        (reply,) = self.replies()
        return reply
