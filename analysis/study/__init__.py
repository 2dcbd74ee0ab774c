"""Studies of the closed loop in one process, from gains to tables: robustness, baselines, convergence."""
