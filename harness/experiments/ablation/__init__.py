"""`springbench ablate`: what each effect of a scene costs and changes, and which effects its motion calls for."""
