"""A camera that a program controls: Motion JPEG over HTTP on the loopback interface.

    python bench/loopback_camera.py FPS    # print its address; serve until the input ends

Its pictures are those of the demonstration clip on a walk back and forth, each with noise of its
own, so that they are neither repeated nor a loop. A frame that its reader does not take in time is
left out, as a camera with one buffer does.
"""

from __future__ import annotations

import contextlib
import sys
import time
from functools import cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Event, Thread
from typing import Literal

import cv2
import numpy as np
from networks import ARTIFACTS

from cvo_edge.input.sources import open_source

State = Literal["on", "off", "hangs"]

# More than the runtime compares a frame with.
_PICTURES, _NOISE, _QUALITY = 600, 2.0, 92
_PART = b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n%b\r\n"


@cache
def pictures() -> list[bytes]:
    """Return the pictures of a walk, as JPEG."""
    clip = [frame.image for frame in open_source(ARTIFACTS / "synthetic-room-clip")]
    random = np.random.default_rng(0)
    place, way, left, found = 0, 1, 5, []
    for _ in range(_PICTURES):
        if left == 0 or not 0 <= place + way < len(clip):
            way, left = -way, int(random.integers(3, 8))
        place, left = place + way, left - 1
        noisy = clip[place] + _NOISE * random.standard_normal(clip[place].shape)
        image = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
        found.append(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes())
    return found


class LoopbackCamera:
    """Serves frames at a rate while its state is ``on``.

    ``off`` refuses and ends connections, ``hangs`` keeps them and sends nothing. ``sent`` holds the
    time of each frame on the monotonic clock.
    """

    def __init__(self, fps: float, state: State = "on") -> None:
        camera, self.fps, self.state, self.sent = self, fps, state, list[float]()
        self._ended = Event()
        shown = pictures()

        class Handler(BaseHTTPRequestHandler):
            def log_message(self, *_: object) -> None:
                """Say nothing."""

            def do_GET(self) -> None:
                if camera.state == "off":
                    self.send_error(503)
                    return
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
                self.end_headers()
                with contextlib.suppress(OSError):
                    for picture in camera.paced(shown):
                        # Before it is handed over: the reader may not take it for long.
                        camera.sent.append(time.monotonic())
                        self.wfile.write(_PART % (len(picture), picture))

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.address = f"http://127.0.0.1:{self._server.server_port}/camera.mjpg"
        Thread(target=self._server.serve_forever, daemon=True).start()

    def paced(self, shown: list[bytes]):  # noqa: ANN201 - a generator of pictures
        """Yield pictures at the camera's rate until it is off."""
        begin, number = time.monotonic(), 0
        while not self._ended.wait(max(0.0, begin + number / self.fps - time.monotonic())):
            if self.state == "off":
                return
            if self.state == "on":
                yield shown[number % len(shown)]
            # Frames whose time has passed meanwhile are left out.
            number = max(number + 1, int((time.monotonic() - begin) * self.fps))

    def close(self) -> None:
        """End all connections."""
        self._ended.set()
        self._server.shutdown()
        self._server.server_close()


if __name__ == "__main__":
    one = LoopbackCamera(float(sys.argv[1]))
    print(one.address, flush=True)
    sys.stdin.read()
    one.close()
