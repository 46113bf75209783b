"""Cost of servers for the live page: `python -m bench.throughput.page_servers`; of aiohttp where it is installed.

Each server runs in a process of its own and sends, four times a second, a state of 40 kB as an event and two pictures
of 120 kB to one reader, as the live page asks for them. Printed: process time per second, and that of the import.
"""

from __future__ import annotations

import argparse
import http.client
import importlib.util
import multiprocessing
import time
from multiprocessing.connection import Connection

PORTS = {"http.server": 8741, "aiohttp": 8742}
STATE, PICTURE = '{"filler": "' + "x" * 40_000 + '"}', bytes(120_000)


def standard(port: int, out: Connection) -> None:
    """The product's own server."""
    begun = time.process_time()
    from lab.runs.watch.board import PageServer

    out.send(time.process_time() - begun)
    with PageServer(str(port), "", lambda over: STATE, lambda name: (PICTURE, {})):
        out.recv()
        begun = time.process_time()
        out.recv()
        out.send(time.process_time() - begun)


def by_aiohttp(port: int, out: Connection) -> None:
    """The same by aiohttp, in an event loop of its own thread as `watch` would need it."""
    begun = time.process_time()
    import asyncio
    import threading

    from aiohttp import web

    out.send(time.process_time() - begun)

    async def state(request: web.Request) -> web.StreamResponse:
        response = web.StreamResponse(headers={"Content-Type": "text/event-stream"})
        await response.prepare(request)
        while True:
            await response.write(f"data: {STATE}\n\n".encode())
            await asyncio.sleep(0.25)

    async def picture(request: web.Request) -> web.Response:
        return web.Response(body=PICTURE, content_type="image/jpeg")

    async def serve() -> None:
        app = web.Application()
        app.add_routes([web.get("/state", state), web.get("/picture", picture)])
        runner = web.AppRunner(app)
        await runner.setup()
        await web.TCPSite(runner, "127.0.0.1", port).start()
        await asyncio.Event().wait()

    threading.Thread(target=lambda: asyncio.run(serve()), daemon=True).start()
    out.recv()
    begun = time.process_time()
    out.recv()
    out.send(time.process_time() - begun)


def read(port: int, seconds: float) -> int:
    """Read as the page does; returns the number of states."""
    end, states = time.perf_counter() + seconds, 0
    events = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
    events.request("GET", "/state")
    stream = events.getresponse()
    while time.perf_counter() < end:
        if stream.readline().startswith(b"data: "):
            states += 1
            for _ in range(2):
                one = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
                one.request("GET", "/picture?camera=left")
                one.getresponse().read()
                one.close()
    events.close()
    return states


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0)
    given = parser.parse_args()
    servers = {"http.server": standard}
    if importlib.util.find_spec("aiohttp") is not None:
        servers["aiohttp"] = by_aiohttp
    for name, server in servers.items():
        ours, theirs = multiprocessing.Pipe()
        process = multiprocessing.Process(target=server, args=(PORTS[name], theirs), daemon=True)
        process.start()
        imported = ours.recv()
        time.sleep(1.0)
        ours.send("begin")
        states = read(PORTS[name], given.seconds)
        ours.send("end")
        used = ours.recv()
        process.kill()
        print(
            f"{name}: {1e3 * used / given.seconds:.1f} ms of process time per second"
            f" ({1e3 * used / states:.2f} ms per state and its pictures), import {1e3 * imported:.0f} ms"
        )


if __name__ == "__main__":
    main()
