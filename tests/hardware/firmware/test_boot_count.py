"""Count of boots in flash, with power cuts at every step."""

import ctypes as c

import pytest

from compiled_firmware import library

ERASED = 0xFFFFFFFF
READ = c.CFUNCTYPE(c.c_uint32, c.c_void_p, c.c_int, c.c_uint32)
WRITE = c.CFUNCTYPE(None, c.c_void_p, c.c_int, c.c_uint32, c.c_uint32)
ERASE = c.CFUNCTYPE(None, c.c_void_p, c.c_int)


class Store(c.Structure):
    _fields_ = (
        ("context", c.c_void_p),
        ("words", c.c_uint32),
        ("read", READ),
        ("write", WRITE),
        ("erase", ERASE),
    )


class Flash:
    """Two pages whose power may fail: a step is then done in part, and all after it not at all.

    Attributes:
        power: steps until the power fails; None for never.
        erasures: how often each page was erased.
    """

    def __init__(self, words=8):
        self.pages = [[ERASED] * words for _ in range(2)]
        self.erasures = [0, 0]
        self.power = None
        count = library().eit_count_boot
        count.restype, count.argtypes = c.c_uint32, [c.POINTER(Store)]
        self._store = Store(None, words, READ(self.read), WRITE(self.write), ERASE(self.erase))
        self.boot = lambda: count(self._store)

    def _left(self):
        """Part of the step that the power lasts for."""
        if self.power is None:
            return 1.0
        self.power -= 1
        return 1.0 if self.power > 0 else 0.5 if self.power == 0 else 0.0

    def read(self, _, page, word):
        return self.pages[page][word]

    def write(self, _, page, word, value):
        left = self._left()
        low_half_stays = 0xFFFF if left == 0.5 else ERASED if left == 0.0 else 0
        self.pages[page][word] &= value | low_half_stays

    def erase(self, _, page):
        left = self._left()
        self.erasures[page] += 1
        words = self.pages[page]
        words[: int(left * len(words))] = [ERASED] * int(left * len(words))


def test_boots_are_counted_over_many_pages():
    flash = Flash()
    assert [flash.boot() for _ in range(100)] == list(range(1, 101))
    assert sum(flash.erasures) == 100 // 4 - 1  # four records a page; the first two came erased
    assert abs(flash.erasures[0] - flash.erasures[1]) <= 1


@pytest.mark.parametrize("before", range(12))
def test_a_power_cut_at_any_step_loses_no_count_but_its_own(before):
    for steps in range(1, 4):
        flash = Flash()
        for _ in range(before):
            flash.boot()
        flash.power = steps
        flash.boot()
        flash.power = None
        after = [flash.boot() for _ in range(10)]
        assert after[0] in {before + 1, before + 2}, steps
        assert after == list(range(after[0], after[0] + 10)), steps


def test_pages_with_anything_in_them_are_used_up_and_then_erased():
    flash = Flash()
    flash.pages = [[0x12345678] * 8, [0] * 8]
    assert [flash.boot() for _ in range(12)] == list(range(1, 13))
