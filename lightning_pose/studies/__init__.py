"""A sweep that ends in a figure and a table: what to show (`figure_spec`), the table, the figure."""
