"""The source chapter reproduced: each of its equations, tables and figures, printed form and corrected form."""
