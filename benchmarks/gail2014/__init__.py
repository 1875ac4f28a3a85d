"""The reference study: the figures of Gail, Leyendecker and Ober-Bloebaum (2014), run again."""
