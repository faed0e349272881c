"""Wire protocols: JSON, Open Inference Protocol over HTTP and gRPC, WebSocket, administration."""
