// where a cell lies among the blocks of its columns
const int block = k / 31;
const int place = k - 31 * block;
const unsigned low = (1u << place) - 1u;
const int block_width = columns.blocks.shape[1];
const int begin = (i * columns.node_counts.c[1] + j) * block_width + block;
