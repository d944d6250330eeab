/* Declarations of kernels.c, for the C compiler and for cffi: plain C, no preprocessor. */

/* Of FFCx: adds the integral over one piece to A, or that over the side where two meet. Arguments: A, coefficients,
   constants, control points (16, 3) or (2, 16, 3), and three that tell which side of the pieces is meant. */
typedef void thccs_kernel(double *, const double *, const double *, const double *, const int *, const uint8_t *,
                          void *);

/* Cells of equal width (extraction.Batch), and the control points. Or facets: each is a cell of one piece, or two pieces
   taken together (sides 2), turned so that kernels see it as side y = 0 of the first and y = 1 of the second. */
typedef struct {
  int32_t sides;           /* 1, or 2 for facets between cells; local = 16 * sides functions on a piece */
  int32_t width;           /* of the rows of dofs and operators, a multiple of 8 */
  int32_t gdim;
  const int32_t *cells;    /* (n, sides) cell numbers */
  const int32_t *dofs;     /* (n, width) scalar dofs, -1 at the end of a row is padding */
  const int32_t *offsets;  /* (n + 1) pieces of the k-th cell: offsets[k] .. offsets[k + 1] */
  const int32_t *nodes;    /* (pieces, local) rows of points */
  const double *operators; /* (pieces, local, width), or NULL: identity, width 16 and one piece a cell */
  const double *points;    /* (nodes, gdim) */
} thccs_batch;

/* A function in a form. */
typedef struct {
  const double *values; /* block_size values a dof, or a cell; NULL: not used here */
  int32_t block_size;
  int32_t is_cellwise;  /* constant on each cell */
} thccs_coefficient;

/* What is integrated, and on which cells of the batch. */
typedef struct {
  thccs_kernel *kernel;
  const double *constants;
  int32_t num_coefficients;
  const thccs_coefficient *coefficients; /* (num_coefficients) */
  int32_t num_cells;
  const int32_t *cells; /* (num_cells) positions in the batch, or NULL: 0 .. num_cells */
} thccs_integral;

/* These four return 0, or -1 when there is no memory. */

/* values[cell] += integral over the cell, or half of that over the facet of two cells. */
int thccs_assemble_cells(const thccs_batch *batch, const thccs_integral *integral, double *values);

/* values[block_size * dof + component] += integral. */
int thccs_assemble_vector(const thccs_batch *batch, const thccs_integral *integral, int32_t block_size,
                          double *values);

/* The matrix of the scalar dofs has rows beginning at indptr. The values are those of the Kronecker product of that
   pattern with dense blocks of rows x columns components. The k-th cell of the batch has n dofs; entry (a, b) of its
   tensor belongs positions[starts[k] + n a + b] entries after the beginning of its row. position_size is 1 (uint8)
   or 2 (uint16). */
int thccs_assemble_matrix(const thccs_batch *batch, const thccs_integral *integral, int32_t rows, int32_t columns, int32_t num_rows,
                          const int32_t *indptr, const int64_t *starts, int32_t position_size,
                          const void *positions, double *values);

/* Local problems on four bubble functions a cell, products of two polynomials along each side: the inner cubic ones
   of Bernstein or, smooth, Hermite's cubics in the middle of the side, piecewise and with no slope at the ends. Pieces
   lie in their cells at origins (pieces, 2), along axes (pieces, 2, 2), each with smooth bubbles in one quarter of its
   cell, or it is the cell. Of a linear form, with coefficients NULL: residuals (cells, 4 * block_size) += form of the
   bubbles. Of a bilinear form, with local coefficients (pieces, 16, block_size) of a function: matrices (cells, 4 *
   block_size, 4 * block_size) += form of them, residuals -= form of function and them. */
int thccs_assemble_on_bubbles(const thccs_batch *batch, const thccs_integral *integral, int32_t block_size,
                              int32_t are_smooth, const double *origins, const double *axes,
                              const double *coefficients, double *matrices, double *residuals);

/* values[cell] = r^T z with matrix (n, n) z = r, r the residual (n), given twice: all three are written over. Infinite
   where there is no z, NaN where an r is not finite. A z that is not unique is 0 where nothing determines it. */
void thccs_solve_local(int32_t num_cells, int32_t n, double *matrices, double *residuals, double *again,
                       double *values);

/* Which dofs share a cell. First with indices NULL and next 0: next[i] becomes the length of row i. Then with next[i]
   the beginning of row i: its columns are written, in order. seen (num_dofs) is -1 before each call. */
void thccs_sparsity(int32_t num_dofs, const int32_t *cell_offsets, const int32_t *cell_dofs,
                    const int32_t *dof_offsets, const int32_t *dof_cells, int32_t *seen, int32_t *next,
                    int32_t *indices);

/* Column indices of the Kronecker product of a pattern with dense blocks of rows x columns components. */
void thccs_blocked_indices(int32_t num_dofs, int32_t rows, int32_t columns, const int32_t *indptr,
                           const int32_t *indices, int32_t *blocked);

/* The positions for thccs_assemble_matrix. dof_locals: which dof of its cell; place (num_dofs) is scratch. */
void thccs_positions(int32_t num_dofs, const int32_t *cell_offsets, const int32_t *cell_dofs,
                     const int32_t *dof_offsets, const int32_t *dof_cells, const int32_t *dof_locals,
                     const int32_t *indptr, const int32_t *indices, int32_t *place, const int64_t *starts,
                     int32_t position_size, void *positions);

/* An FFCx expression on n pieces. Coefficients (n, num_coefficients), control points (n, 16, 3), values
   (n, num_values), which are added to. */
void thccs_tabulate(thccs_kernel *kernel, int32_t n, int32_t num_values, int32_t num_coefficients,
                    const double *coefficients, const double *constants, const double *points, double *values);

/* Bicubic patches in Bernstein form, coefficients (patches, 16, size), evaluated at the points uv (n, 2) of the
   patches (n): the values, the derivatives along u and v, the second ones uu, uv, vv; the first `rows` (1, 3, 6)
   of these. out (rows, n, size). */
void thccs_evaluate_patches(int64_t n, const int32_t *patches, const double *uv, int32_t size,
                            const double *coefficients, int32_t rows, double *out);

/* The different columns of the rows of each cell, ascending: columns[offsets[c] .. offsets[c + 1]], offsets (cells + 1).
   Cell c has rows[cell_rows[c] .. cell_rows[c + 1]] of the CSR matrix (indptr, indices). columns has a place for each
   entry of these rows; seen (matrix columns) is -1 before. */
void thccs_cell_columns(int32_t num_cells, const int32_t *cell_rows, const int32_t *rows, const int32_t *indptr,
                        const int32_t *indices, int32_t *seen, int32_t *offsets, int32_t *columns);

/* The rows of each cell as dense blocks over its columns. The block of cell c, width[c] wide, begins at
   values[starts[c]]. place (matrix columns) is scratch; values are 0 before. */
void thccs_dense_rows(int32_t num_cells, const int32_t *cell_rows, const int32_t *rows, const int32_t *indptr,
                      const int32_t *indices, const double *data, const int32_t *offsets, const int32_t *columns,
                      const int32_t *width, const int64_t *starts, int32_t *place, double *values);

/* The matrix (num_rows rows) of the sums of n triplets, columns ascending; those with a negative row or column are
   dropped. indptr (num_rows + 1) is 0 before; indices and data have n places, of which indptr[num_rows] are used. */
void thccs_sum_triplets(int64_t n, const int32_t *rows, const int32_t *columns, const double *values,
                        int32_t num_rows, int32_t *indptr, int32_t *indices, double *data);

/* The product of two CSR matrices, columns ascending, without zeros. unit, or NULL: -1 for a row of the product, -2 for
   an empty row, else the column in which there is a 1. place (columns of b) is -1 before. */
void thccs_product(int32_t num_rows, const int32_t *a_indptr, const int32_t *a_indices, const double *a_data,
                   const int32_t *b_indptr, const int32_t *b_indices, const double *b_data, const int32_t *unit,
                   int32_t *place, int32_t *indptr, int32_t *indices, double *data);

/* Rows of a CSR matrix, in the given order; indptr is that of the result. */
void thccs_rows(int32_t num_rows, const int32_t *rows, const int32_t *a_indptr, const int32_t *a_indices,
                const double *a_data, const int32_t *indptr, int32_t *indices, double *data);

/* Rows of a CSR matrix, columns by their place; those whose place is negative are left out. indptr (num_rows + 1),
   indices and data are those of the result; these two have a place for each entry of the rows. */
void thccs_restrict(int32_t num_rows, const int32_t *rows, const int32_t *place, const int32_t *a_indptr,
                    const int32_t *a_indices, const double *a_data, int32_t *indptr, int32_t *indices, double *data);

/* Sums of absolute values of the rows and columns of a CSR matrix, which are 0 before. */
void thccs_absolute_sums(int32_t num_rows, const int32_t *indptr, const int32_t *indices, const double *data,
                         double *of_rows, double *of_columns);

/* Where the entries of a CSR matrix go that is split into its first num_owned columns, own, and the others, whose
   columns become numbers[column - num_owned]. own_indptr and other_indptr have num_rows + 1 places. */
void thccs_split_pattern(int32_t num_rows, int32_t num_owned, const int32_t *indptr, const int32_t *indices,
                         const int32_t *numbers, int32_t *own_indptr, int32_t *own_indices, int32_t *other_indptr,
                         int32_t *other_indices);

/* The n values of such a matrix. */
void thccs_split_values(int64_t n, int32_t num_owned, const int32_t *indices, const double *values, double *own,
                        double *others);
