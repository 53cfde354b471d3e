"""Version 1 of the contract: ``trajectron_pb2`` and ``trajectron_pb2_grpc``, both generated."""
