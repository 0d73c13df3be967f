"""Readings of `eitskin live MODEL --udp 5005`, printed as they come; docs/robot.md has the records.

python listen.py 5005
"""

import json
import socket
import sys

PORT = int(sys.argv[1]) if len(sys.argv) > 1 else 5005
LEFT = int(sys.argv[2]) if len(sys.argv) > 2 else -1  # records until it ends; -1 for no end


def shown(record: dict) -> str:
    """Record as a line of text."""
    if record["kind"] == "silence":
        return f"nothing for {record['seconds']:.0f} s"
    angle = record["bend_angle_deg"]
    parts = [f"{record['number']}: {record['state'] or 'unknown'}"]
    parts.append("nan deg" if angle is None else f"{angle:+.1f} deg")
    for touch in record["touches"] or ():
        force = "nan" if touch["force"] is None else f"{touch['force']:.1f}"
        x, y = 1e3 * touch["x"], 1e3 * touch["y"]
        parts.append(f"touch at ({x:.1f}, {y:.1f}) mm with {force} N")
    return ", ".join(parts)


with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as incoming:
    incoming.bind(("127.0.0.1", PORT))
    incoming.settimeout(3.0)
    print("listening at", incoming.getsockname()[1], flush=True)
    while LEFT != 0:
        try:
            record = json.loads(incoming.recv(65536))
        except TimeoutError:  # a second without a frame is told: eitskin itself has ended
            print("no records for 3 s", flush=True)
            continue
        LEFT -= 1
        if record["version"] == 1:
            print(shown(record), flush=True)
