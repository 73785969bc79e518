"""What the rows of `springbench accuracy` say: pictures, tables, findings and one interactive page."""
