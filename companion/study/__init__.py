"""Studies: commands that evaluate the estimation methods and print tables and plots."""
