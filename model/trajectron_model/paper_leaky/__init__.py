"""The paper's model under the paper's conditions, leaks included: a reproduction, never a service.

WARNING: its inputs contain the future. Velocities and accelerations are central differences
over whole tracks, inputs are standardised with statistics of the very set they are tested on,
and edges fade in before they exist. It exists to show that the figures of the paper's Table 1
come from these conditions; its figures must not be compared with causal ones.

It shares no base class and no checkpoint format with the model that is served, and stands in
no registry, so that nothing can load it by mistake.
"""

WARNING = "leaking inputs: central differences, test-set standardisation, look-ahead edges"

NAME = "paper-leaky"
