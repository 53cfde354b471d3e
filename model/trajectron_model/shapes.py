"""The letters that name an array's axes, the same in every file of the package.

====== =================================================================
letter axis
====== =================================================================
N      nodes: rows of a scene, or of several scenes stacked
A      agents of a frame, or those a forecast is asked for
E      directed edges, a row each
K      edge types of a receiving node: one for each type of sender
T      history steps
H      horizon steps
Z      latent values
M      mixture components
S      samples
R      rows of a rollout: one for each (agent, sample) or (agent, latent value)
F      features of a node at a step
G      features of the neighbours at a step, summed over an edge type
D      size of h_enc
====== =================================================================

Covariances of two dimensions are stored as three numbers: xx, xy, yy.
"""
