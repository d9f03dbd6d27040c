"""One thread for the linear algebra of every process: its small matrices gain nothing from more.

Where several processes share the cores, the threads of OpenBLAS wait for each other: a fit through the camera's chain
took 0.5 s instead of 0.15 s on two cores.
"""

ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""Environment variables, to be set before NumPy is loaded."""
