"""What decides: classifier inference, segments and the model file, on numpy alone."""
