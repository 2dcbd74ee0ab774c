"""Linear PI Inequalities for any PIE: rows, semidefinite programs, certificates (theory, section 3)."""
