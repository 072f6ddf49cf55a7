"""What a study asks for: plugins and their options, study files, and the matrix of cells."""
