"""General-purpose pins of ports A, B and C."""

MODER, OTYPER, OSPEEDR, PUPDR, IDR, ODR, BSRR = 0x00, 0x04, 0x08, 0x0C, 0x10, 0x14, 0x18
AFRL, AFRH = 0x20, 0x24
OUTPUT, ALTERNATE = 1, 2
DEBUG = (("A", 13), ("A", 14))  # the debugger's, which is how the board is flashed

# After a reset; RM0383, GPIO registers.
RESET = {
    "A": {MODER: 0xA8000000, OSPEEDR: 0x0C000000, PUPDR: 0x64000000},
    "B": {MODER: 0x00000280, OSPEEDR: 0x000000C0, PUPDR: 0x00000100},
    "C": {},
}


class Pins:
    """Registers of three ports."""

    def __init__(self):
        names = (MODER, OTYPER, OSPEEDR, PUPDR, ODR, AFRL, AFRH)
        self._ports = {
            port: dict.fromkeys(names, 0) | registers for port, registers in RESET.items()
        }

    def mode(self, port, number):
        return self._ports[port][MODER] >> 2 * number & 3

    def function(self, port, number):
        """Number of the alternate function; None where the pin has none."""
        if self.mode(port, number) != ALTERNATE:
            return None
        word = self._ports[port][AFRH if number >= 8 else AFRL]
        return word >> 4 * (number % 8) & 15

    def driven(self, port, number):
        """Level that the pin drives; None for one that is no output."""
        if self.mode(port, number) != OUTPUT:
            return None
        return bool(self._ports[port][ODR] >> number & 1)

    def access(self, port, offset, value, chip):
        registers = self._ports[port]
        if value is None:
            if offset == IDR:
                return sum(chip.level(port, number) << number for number in range(16))
            return registers.get(offset, 0)
        if offset == BSRR:
            registers[ODR] = registers[ODR] & ~(value >> 16) | value & 0xFFFF
        elif offset in registers:
            registers[offset] = value
        else:
            chip.complain(f"port {port} has no register {offset:#x} to write")
        if offset == MODER:
            for debug in DEBUG:
                if debug[0] == port and self.mode(*debug) != ALTERNATE:
                    chip.complain("a pin of the debugger was taken")
        chip.pin_changed()
        return 0
