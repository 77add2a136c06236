"""Missing frames of an H.264 stream, by the numbers that reference frames carry (ITU-T H.264, 7.4.3: frame_num).

FFmpeg decodes on over a missing frame, and shows a wrong picture until the next key frame.
"""

from __future__ import annotations

import re

_UNITS = re.compile(rb"\x00\x00\x01")
_HIGH_PROFILES = (100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135)
"""profile_idc whose parameter sets tell the chroma format (7.3.2.1.1)."""
_HEAD = 64
"""Bytes of a slice that are looked at; its frame_num lies within the first ten."""
_PARAMETERS = 4096
"""Bytes of a parameter set that are looked at; with all scaling lists it has a few hundred."""
_SLICE, _IDR, _SPS = 1, 5, 7
"""nal_unit_type, table 7-1."""


class FrameNumbers:
    """Follows one stream from a key frame on."""

    def __init__(self) -> None:
        self._bits = 0
        """Bits of frame_num; 0 where they are of no use: no parameter set was read, or it allows gaps."""
        self._colour_planes = False
        """Each slice is of one colour plane, which it names before frame_num."""
        self._last = -1
        """frame_num of the last reference frame, -1 before the first."""

    def follows(self, data: bytes) -> bool:
        """Whether nothing that the frame of this packet may refer to is missing before it."""
        starts = [unit.end() for unit in _UNITS.finditer(data)]
        for start, stop in zip(starts, [*starts, len(data) + 3][1:], strict=True):
            if start >= len(data):
                continue
            kind, reference = data[start] & 0x1F, bool(data[start] & 0x60)
            try:
                if kind == _SPS:
                    self._read_parameters(_Bits(data[start + 1 : min(stop - 3, start + _PARAMETERS)]))
                elif kind in (_SLICE, _IDR):
                    return self._slice(_Bits(data[start + 1 : start + _HEAD]), kind == _IDR, reference)
            except IndexError:  # cut short: left to the decoder
                return True
        return True

    def _slice(self, bits: _Bits, idr: bool, reference: bool) -> bool:
        if not self._bits:
            return True
        bits.exp_golomb(3)  # first_mb_in_slice, slice_type, pic_parameter_set_id
        bits.read(2 if self._colour_planes else 0)
        number = bits.read(self._bits)
        known, expected = self._last >= 0 and not idr, (self._last + 1) % (1 << self._bits)
        sound = not known or number in (self._last, expected)
        if reference:
            self._last = number
        return sound

    def _read_parameters(self, bits: _Bits) -> None:
        """seq_parameter_set_data, 7.3.2.1.1, as far as gaps_in_frame_num_value_allowed_flag."""
        profile = bits.read(8)
        bits.read(16)  # constraints, level
        bits.exp_golomb()  # seq_parameter_set_id
        self._colour_planes = False
        if profile in _HIGH_PROFILES:
            chroma = bits.exp_golomb()
            self._colour_planes = chroma == 3 and bits.read(1) == 1
            bits.exp_golomb(2)  # bit depths of luma and chroma
            bits.read(1)  # lossless transform
            if bits.read(1):
                for size in [16] * 6 + [64] * (6 if chroma == 3 else 2):
                    bits.skip_scaling_list(size)
        size = bits.exp_golomb() + 4
        order = bits.exp_golomb()  # pic_order_cnt_type
        if order == 0:
            bits.exp_golomb()
        elif order == 1:
            bits.read(1)
            bits.exp_golomb(2)
            bits.exp_golomb(bits.exp_golomb())
        bits.exp_golomb()  # max_num_ref_frames
        self._bits = size if size <= 16 and not bits.read(1) else 0


class _Bits:
    """The payload of a unit bit by bit, most significant first. Raises IndexError behind its end."""

    def __init__(self, data: bytes) -> None:
        self._data = data.replace(b"\x00\x00\x03", b"\x00\x00")  # emulation prevention, 7.4.1
        self._at = 0

    def read(self, count: int) -> int:
        value = 0
        for _ in range(count):
            value = value << 1 | (self._data[self._at >> 3] >> (7 - (self._at & 7)) & 1)
            self._at += 1
        return value

    def exp_golomb(self, count: int = 1) -> int:
        """The last of so many ue(v), 9.1; of se(v) it is the code number."""
        value = 0
        for _ in range(count):
            zeros = 0
            while not self.read(1):
                zeros += 1
            value = (1 << zeros) - 1 + self.read(zeros)
        return value

    def skip_scaling_list(self, size: int) -> None:
        """Behind the flag that it is there, 7.3.2.1.1.1: differences of se(v) until the next scale is 0."""
        scale = 8 * self.read(1)
        while scale and size:
            code = self.exp_golomb()
            scale = (scale + (code + 1 >> 1 if code & 1 else -(code >> 1))) % 256
            size -= 1
