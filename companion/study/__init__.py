"""Studies: questions an operator or an analyst asks of the mathematics, answered as tables and plots."""
