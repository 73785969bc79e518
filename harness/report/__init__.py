"""Pictures and plots, drawn from rows and recordings alone: nothing here simulates."""
