"""Ask a camera of `plain_camera.on_duty` for an image: snapshot.py PORT SCREEN OUTPUT.png [...];
it starts at once.
"""

import socket
import sys

with socket.create_connection(("127.0.0.1", int(sys.argv[1])), timeout=60) as camera:
    camera.sendall("\0".join(sys.argv[2:]).encode() + b"\n")
    said = camera.recv(1000).decode()
sys.exit(said if said != "ok" else 0)
