"""What is known exactly: surfaces, simulated captures, contracts for plugins, evaluation.

Public, for the authors of plugins as for nLights itself:

- `nlights_core.testing.surfaces`: surfaces with exact heights and normals;
- `nlights_core.testing.contracts`: one contract per kind of algorithm, subclassed in three lines;
- `nlights_core.testing.scenes` and `nlights_core.testing.simulation`: a simulated capture;
- `nlights_core.testing.evaluation`: products compared with the simulator's truth.
"""
