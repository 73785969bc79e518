"""Operations on existing results: compaction, merging, publication and verification."""
