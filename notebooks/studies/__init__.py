"""What single notebooks need and nobody else: contenders, tables, tuned constants, figures."""
