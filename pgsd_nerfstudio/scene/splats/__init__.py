"""Read Gaussians from the files that trainers and converters write; `reading` chooses by what a file holds."""
