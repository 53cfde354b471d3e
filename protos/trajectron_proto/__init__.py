"""Code generated from ``protos/trajectron``: the messages and services of the contract."""
