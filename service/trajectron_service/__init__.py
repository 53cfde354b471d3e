"""The prediction service: sessions, batching, HTTP and gRPC around the Trajectron."""
