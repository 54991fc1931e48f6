"""A policy server for LeRobot's asynchronous client: answers every observation with one chunk of careless actions.

Runs in the environment of `virtual_environment`: python chunk_server.py PORT_FILE

It chooses a free port and writes it into PORT_FILE; a signal ends it.
"""

import pickle
import sys
import threading
import time
from concurrent import futures
from pathlib import Path

import grpc
import torch
from lerobot.async_inference.helpers import TimedAction
from lerobot.transport import services_pb2, services_pb2_grpc
from lerobot.transport.utils import receive_bytes_in_chunks
from lerobot_robot_recording_servos import ACTIONS

CHUNK = 15
RATE = 30.0


class ChunkServer(services_pb2_grpc.AsyncInferenceServicer):
    """Actions that follow the newest observation."""

    def __init__(self):
        self._seen, self._count = None, 0

    def Ready(self, request, context):  # noqa: N802  (name in the protocol)
        """Answer the handshake."""
        return services_pb2.Empty()

    def SendPolicyInstructions(self, request, context):  # noqa: N802
        """Accept any policy."""
        return services_pb2.Empty()

    def SendObservations(self, request_iterator, context):  # noqa: N802
        """Keep the newest observation."""
        received = receive_bytes_in_chunks(request_iterator, None, threading.Event(), "observation")
        self._seen = pickle.loads(received)
        return services_pb2.Empty()

    def GetActions(self, request, context):  # noqa: N802
        """One chunk for a new observation, else nothing."""
        seen, self._seen = self._seen, None
        if seen is None:
            time.sleep(0.005)
            return services_pb2.Empty()
        goal, self._count = torch.tensor(ACTIONS[self._count % len(ACTIONS)]), self._count + 1
        first, stamp = seen.get_timestep(), time.time()
        chunk = [TimedAction(timestamp=stamp + i / RATE, timestep=first + i, action=goal.clone()) for i in range(CHUNK)]
        return services_pb2.Actions(data=pickle.dumps(chunk))


def main():
    server = grpc.server(futures.ThreadPoolExecutor(max_workers=4))
    services_pb2_grpc.add_AsyncInferenceServicer_to_server(ChunkServer(), server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    Path(sys.argv[1]).write_text(str(port))
    server.wait_for_termination()


if __name__ == "__main__":
    main()
