"""Frames in C and in Python understand each other, and refuse everything else."""

import ctypes

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.safety.target.frames import MAX_PAYLOAD, Frame, FrameReader, decode_frame, encode_frame
from tests.firmware.c_library import load_library

KEY = bytes(range(16))
MAX_BYTES = 8 + MAX_PAYLOAD + 12
PAYLOADS = st.one_of(st.binary(max_size=MAX_PAYLOAD), st.integers(0, MAX_PAYLOAD).map(bytes))


class Key(ctypes.Structure):
    _fields_ = [("low", ctypes.c_uint64), ("high", ctypes.c_uint64)]


class Reader(ctypes.Structure):
    _fields_ = [
        ("bytes", ctypes.c_uint8 * MAX_BYTES),
        ("size", ctypes.c_uint32),
        *((name, ctypes.c_uint8) for name in ("left", "block", "overflow")),
    ]


class CFrame(ctypes.Structure):
    _fields_ = [
        ("type", ctypes.c_uint8),
        ("sequence", ctypes.c_uint32),
        ("payload_size", ctypes.c_uint32),
        ("payload", ctypes.POINTER(ctypes.c_uint8)),
    ]


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    found = load_library(tmp_path_factory.mktemp("frames"), "firmware/protocol/frame.c", "firmware/protocol/siphash.c")
    found.frame_encode.restype = ctypes.c_uint32
    return found


def key():
    return Key(int.from_bytes(KEY[:8], "little"), int.from_bytes(KEY[8:], "little"))


def read_in_c(library, encoded):
    """The frames that the reader in C accepts from these bytes."""
    reader, found = Reader(), []
    library.frame_reader_clear(ctypes.byref(reader))
    for byte in encoded:
        if library.frame_reader_add(ctypes.byref(reader), ctypes.c_uint8(byte)):
            frame = CFrame()
            if library.frame_parse(ctypes.byref(reader), ctypes.byref(frame)) == 0 and library.frame_tag_valid(
                ctypes.byref(frame), ctypes.byref(key())
            ):
                payload = bytes(frame.payload[: frame.payload_size])
                found.append(Frame(frame.type, frame.sequence, payload))
            library.frame_reader_clear(ctypes.byref(reader))
    return found


@settings(max_examples=200, deadline=None)
@given(kind=st.integers(0, 255), sequence=st.integers(0, 2**32 - 1), payload=PAYLOADS)
def test_each_side_reads_the_frames_of_the_other(library, kind, sequence, payload):
    encoded = encode_frame(kind, sequence, payload, KEY)
    assert read_in_c(library, encoded) == [Frame(kind, sequence, payload)]
    own = (ctypes.c_uint8 * (MAX_BYTES + 32))()
    size = library.frame_encode(
        ctypes.c_uint8(kind), ctypes.c_uint32(sequence), payload, len(payload), ctypes.byref(key()), own
    )
    (piece,) = FrameReader().feed(bytes(own[:size]))
    assert decode_frame(piece, KEY) == Frame(kind, sequence, payload)


@pytest.mark.parametrize("size", [236, 253, 254, 255, 508, 1000])
@pytest.mark.parametrize("last", [b"\0", b"\1"])
def test_runs_without_a_zero_longer_than_a_block_are_read(library, size, last):
    payload = bytes([7]) * (size - 1) + last
    assert read_in_c(library, encode_frame(9, 0x01010101, payload, KEY)) == [Frame(9, 0x01010101, payload)]


def test_a_payload_beyond_the_largest_is_not_encoded(library):
    encoded = (ctypes.c_uint8 * (MAX_BYTES + 32))()
    payload = bytes(MAX_PAYLOAD + 1)
    assert library.frame_encode(1, 1, payload, len(payload), ctypes.byref(key()), encoded) == 0


@settings(max_examples=200, deadline=None)
@given(payload=st.binary(max_size=60), data=st.data())
def test_a_frame_with_a_changed_bit_is_refused_on_both_sides(library, payload, data):
    encoded = bytearray(encode_frame(9, 7, payload, KEY))
    at = data.draw(st.integers(0, 8 * len(encoded) - 9))
    encoded[at // 8] ^= 1 << at % 8
    assert read_in_c(library, encoded) == []
    assert [decode_frame(piece, KEY) for piece in FrameReader().feed(bytes(encoded))] in ([None], [None, None])


def test_a_frame_of_another_key_is_refused(library):
    encoded = encode_frame(9, 7, b"payload", bytes(16))
    assert read_in_c(library, encoded) == []
    assert decode_frame(encoded[:-1], KEY) is None


@settings(max_examples=100, deadline=None)
@given(noise=st.binary(max_size=2 * MAX_BYTES))
def test_a_frame_after_any_bytes_and_a_delimiter_is_read(library, noise):
    encoded = encode_frame(9, 7, b"payload", KEY)
    assert read_in_c(library, noise + b"\0" + encoded)[-1:] == [Frame(9, 7, b"payload")]
    assert [decode_frame(piece, KEY) for piece in FrameReader().feed(noise + b"\0" + encoded)][-1] == Frame(
        9, 7, b"payload"
    )
