/* All loops of the project that numpy can't do over all cells at once. Compiled by jit.library(). */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "kernels.h"

enum { LOCAL = 16 }; /* functions on a piece */

/* ---- Assembly -------------------------------------------------------------------------------------------------- */

/* Loops are over cells, whose pieces have 16 functions, and over facets, where two pieces meet that have 32 together.
   Code for both is inline, and called with constants: that makes loops of their own. */
#define INLINE static inline __attribute__((always_inline))

/* Of FFCx's reference square, sides y = 0 of the first piece and y = 1 of the second, and that both run alike: pieces
   of facets are turned that way. Of no interest to kernels of cells. */
static const int FACETS[2] = {0, 3};
static const uint8_t PERMUTATIONS[2] = {0, 0};

/* Space for one cell or facet at a time, in one allocation. */
typedef struct {
  double points[2 * 3 * LOCAL]; /* the third coordinate stays 0 in the plane */
  double *cell_coefficients;    /* (width, block size) of each coefficient in turn, (sides, block size) of cellwise ones */
  double *piece_coefficients;   /* (local, block size) of each coefficient in turn, again but for cellwise ones */
  double *piece_tensor;
  double *cell_tensor;
  double *block;   /* (local, local): one pair of components of piece_tensor, A */
  double *half;    /* (local, width): A^T C */
  double *product; /* (width, width): C^T A C */
  double *part_coefficients; /* piece_coefficients of a part of the piece, and behind them (local, components) values */
} workspace;

/* Return the allocation, to be freed, or NULL. */
static void *make_workspace(workspace *work, const thccs_batch *batch, const thccs_integral *integral,
                            int64_t components)
{
  const int64_t w = batch->width, local = LOCAL * batch->sides;
  int64_t block_sizes = 0;
  for (int32_t i = 0; i < integral->num_coefficients; ++i)
    block_sizes += integral->coefficients[i].block_size;
  const int64_t sizes[] = {w * block_sizes, local * block_sizes, local * local * components, w * w * components,
                           local * local, local * w, w * w, local * (block_sizes + components)};
  int64_t total = 0;
  for (int i = 0; i < 8; ++i)
    total += sizes[i];
  void *memory = calloc(total + 8, sizeof(double));
  if (!memory)
    return NULL;
  double *next = (double *)(((uintptr_t)memory + 63) / 64 * 64);
  memset(work->points, 0, sizeof work->points);
  double **parts[] = {&work->cell_coefficients, &work->piece_coefficients, &work->piece_tensor,
                      &work->cell_tensor,       &work->block,              &work->half,
                      &work->product,           &work->part_coefficients};
  for (int i = 0; i < 8; ++i) {
    *parts[i] = next;
    next += sizes[i];
  }
  return memory;
}

/* Values of the coefficients at the dofs of a cell or facet, or at its cells. */
INLINE void gather_coefficients(int sides, const thccs_batch *batch, const thccs_integral *integral, int32_t k,
                                double *out)
{
  for (int32_t i = 0; i < integral->num_coefficients; ++i) {
    const thccs_coefficient *w = integral->coefficients + i;
    const int32_t bs = w->block_size, n = w->is_cellwise ? sides : batch->width;
    const int32_t *from = w->is_cellwise ? batch->cells + (int64_t)sides * k : batch->dofs + (int64_t)batch->width * k;
    if (w->values)
      for (int32_t j = 0; j < n; ++j)
        for (int32_t c = 0; c < bs; ++c)
          out[j * bs + c] = from[j] < 0 ? 0.0 : w->values[(int64_t)bs * from[j] + c];
    out += (int64_t)n * bs;
  }
}

/* Their local B-spline coefficients on a piece: operator @ values. */
INLINE void extract_coefficients(int sides, const thccs_integral *integral, int32_t width, const double *operator,
                                 const double *in, double *out)
{
  for (int32_t i = 0; i < integral->num_coefficients; ++i) {
    const thccs_coefficient *w = integral->coefficients + i;
    const int32_t bs = w->block_size;
    if (w->is_cellwise) {
      memcpy(out, in, sides * bs * sizeof(double));
      in += sides * bs;
      out += sides * bs;
      continue;
    }
    if (w->values)
      for (int32_t r = 0; r < sides * LOCAL; ++r)
        for (int32_t c = 0; c < bs; ++c) {
          double sum = 0.0;
          for (int32_t j = 0; j < width; ++j)
            sum += operator[r * width + j] * in[j * bs + c];
          out[r * bs + c] = sum;
        }
    in += (int64_t)width * bs;
    out += (int64_t)sides * LOCAL * bs;
  }
}

/* work->points = those of a piece or facet. Return its coefficients; those of its cell have been gathered. */
INLINE const double *load_piece(int sides, const thccs_batch *batch, const thccs_integral *integral, int64_t piece,
                                workspace *work)
{
  const int local = sides * LOCAL;
  const int32_t *nodes = batch->nodes + local * piece;
  for (int i = 0; i < local; ++i)
    for (int c = 0; c < batch->gdim; ++c)
      work->points[3 * i + c] = batch->points[(int64_t)batch->gdim * nodes[i] + c];
  if (!batch->operators || !integral->num_coefficients)
    return work->cell_coefficients;
  extract_coefficients(sides, integral, batch->width, batch->operators + local * batch->width * piece,
                       work->cell_coefficients, work->piece_coefficients);
  return work->piece_coefficients;
}

/* work->piece_tensor = the integral over what work->points map. */
INLINE void integrate(const thccs_integral *integral, const double *coefficients, int64_t size, workspace *work)
{
  memset(work->piece_tensor, 0, size * sizeof(double));
  integral->kernel(work->piece_tensor, coefficients, integral->constants, work->points, FACETS, PERMUTATIONS, NULL);
}

/* work->piece_tensor = the integral over a piece or facet. */
INLINE void integrate_piece(int sides, const thccs_batch *batch, const thccs_integral *integral, int64_t piece,
                            int64_t size, workspace *work)
{
  integrate(integral, load_piece(sides, batch, integral, piece, work), size, work);
}

static int32_t chosen(const thccs_integral *integral, int32_t i)
{
  return integral->cells ? integral->cells[i] : i;
}

INLINE int assemble_cells(int sides, const thccs_batch *batch, const thccs_integral *integral, double *values)
{
  workspace work;
  void *memory = make_workspace(&work, batch, integral, 1);
  if (!memory)
    return -1;
  for (int32_t i = 0; i < integral->num_cells; ++i) {
    const int32_t k = chosen(integral, i);
    gather_coefficients(sides, batch, integral, k, work.cell_coefficients);
    for (int64_t piece = batch->offsets[k]; piece < batch->offsets[k + 1]; ++piece) {
      integrate_piece(sides, batch, integral, piece, 1, &work);
      for (int s = 0; s < sides; ++s)
        values[batch->cells[(int64_t)sides * k + s]] += work.piece_tensor[0] / sides;
    }
  }
  free(memory);
  return 0;
}

int thccs_assemble_cells(const thccs_batch *batch, const thccs_integral *integral, double *values)
{
  return batch->sides == 1 ? assemble_cells(1, batch, integral, values) : assemble_cells(2, batch, integral, values);
}

INLINE int assemble_vector(int sides, const thccs_batch *batch, const thccs_integral *integral, int32_t block_size,
                           double *values)
{
  workspace work;
  void *memory = make_workspace(&work, batch, integral, block_size);
  if (!memory)
    return -1;
  const int32_t bs = block_size, width = batch->width, local = sides * LOCAL;
  for (int32_t i = 0; i < integral->num_cells; ++i) {
    const int32_t k = chosen(integral, i);
    const int32_t *dofs = batch->dofs + (int64_t)width * k;
    gather_coefficients(sides, batch, integral, k, work.cell_coefficients);
    const double *tensor = work.piece_tensor;
    if (batch->operators) {
      tensor = work.cell_tensor;
      memset(work.cell_tensor, 0, width * bs * sizeof(double));
    }
    for (int64_t piece = batch->offsets[k]; piece < batch->offsets[k + 1]; ++piece) {
      integrate_piece(sides, batch, integral, piece, local * bs, &work);
      if (batch->operators) {
        const double *operator = batch->operators + local * width * piece;
        for (int32_t r = 0; r < local; ++r)
          for (int32_t j = 0; j < width; ++j)
            for (int32_t c = 0; c < bs; ++c)
              work.cell_tensor[j * bs + c] += operator[r * width + j] * work.piece_tensor[r * bs + c];
      }
    }
    for (int32_t j = 0; j < width && dofs[j] >= 0; ++j)
      for (int32_t c = 0; c < bs; ++c)
        values[(int64_t)bs * dofs[j] + c] += tensor[j * bs + c];
  }
  free(memory);
  return 0;
}

int thccs_assemble_vector(const thccs_batch *batch, const thccs_integral *integral, int32_t block_size,
                          double *values)
{
  return batch->sides == 1 ? assemble_vector(1, batch, integral, block_size, values)
                           : assemble_vector(2, batch, integral, block_size, values);
}

/* As many doubles as one register holds: wider vectors are legal C but go through memory. */
#if defined(__AVX512F__)
enum { LANES = 8 };
#elif defined(__AVX__)
enum { LANES = 4 };
#else
enum { LANES = 2 };
#endif
typedef double vector __attribute__((vector_size(8 * LANES), aligned(8), may_alias));

/* out (m, n) += x^T y with x (depth, m) and y (depth, n), m and n multiples of 8: eight registers of sums at a time. */
INLINE void add_product(int depth, int32_t m, int32_t n, const double *restrict x, const double *restrict y,
                        double *restrict out)
{
  for (int32_t j = 0; j < n; j += LANES)
    for (int32_t i = 0; i < m; i += 8) {
      vector sum[8];
      for (int a = 0; a < 8; ++a)
        sum[a] = *(const vector *)(out + (i + a) * n + j);
      for (int k = 0; k < depth; ++k) {
        const vector right = *(const vector *)(y + k * n + j);
        for (int a = 0; a < 8; ++a)
          sum[a] += x[k * m + i + a] * right;
      }
      for (int a = 0; a < 8; ++a)
        *(vector *)(out + (i + a) * n + j) = sum[a];
    }
}

/* work->cell_tensor (width, rows, width, columns) += C^T A C for each pair of components of the piece's A. */
INLINE void add_extracted(int local, int32_t rows, int32_t columns, int32_t width, const double *operator,
                          workspace *work)
{
  for (int32_t r = 0; r < rows; ++r)
    for (int32_t c = 0; c < columns; ++c) {
      const double *block = work->piece_tensor;
      double *product = work->cell_tensor;
      if (rows * columns > 1) {
        for (int32_t i = 0; i < local; ++i)
          for (int32_t j = 0; j < local; ++j)
            work->block[local * i + j] = work->piece_tensor[((i * rows + r) * local + j) * columns + c];
        memset(work->product, 0, width * width * sizeof(double));
        block = work->block;
        product = work->product;
      }
      memset(work->half, 0, local * width * sizeof(double));
      add_product(local, local, width, block, operator, work->half);
      add_product(local, width, width, work->half, operator, product);
      if (rows * columns > 1)
        for (int32_t i = 0; i < width; ++i)
          for (int32_t j = 0; j < width; ++j)
            work->cell_tensor[((i * rows + r) * width + j) * columns + c] += work->product[width * i + j];
    }
}

/* Where the entries of a cell's tensor go: see thccs_assemble_matrix. */
typedef struct {
  int32_t num_rows;
  const int32_t *indptr;
  const void *positions;
  int32_t position_size;
} target;

/* values += tensor (width, rows, width, columns), of which the first n functions are used; only those with a row. */
INLINE void add_rows(int32_t n, int32_t width, const int32_t *dofs, int32_t rows, int32_t columns, target into,
                     const double *restrict tensor, double *restrict values)
{
  const uint8_t *narrow = into.positions;
  const uint16_t *wide = into.positions;
  for (int32_t a = 0; a < n; ++a, narrow += n, wide += n) {
    if (dofs[a] >= into.num_rows) {
      tensor += rows * width * columns;
      continue;
    }
    const int64_t begin = into.indptr[dofs[a]], length = into.indptr[dofs[a] + 1] - begin;
    for (int32_t r = 0; r < rows; ++r, tensor += width * columns) {
      double *row = values + (begin * rows + r * length) * columns;
      for (int32_t b = 0; b < n; ++b) {
        double *to = row + columns * (into.position_size == 1 ? narrow[b] : wide[b]);
        for (int32_t c = 0; c < columns; ++c)
          to[c] += tensor[b * columns + c];
      }
    }
  }
}

INLINE int assemble_matrix(int sides, const thccs_batch *batch, const thccs_integral *integral, int32_t rows,
                           int32_t columns, int32_t num_rows, const int32_t *indptr, const int64_t *starts, int32_t position_size,
                           const void *positions, double *values)
{
  workspace work;
  const int32_t width = batch->width, components = rows * columns, local = sides * LOCAL;
  void *memory = make_workspace(&work, batch, integral, components);
  if (!memory)
    return -1;
  const double *tensor = batch->operators ? work.cell_tensor : work.piece_tensor;
  for (int32_t i = 0; i < integral->num_cells; ++i) {
    const int32_t k = chosen(integral, i);
    const int32_t *dofs = batch->dofs + (int64_t)width * k;
    gather_coefficients(sides, batch, integral, k, work.cell_coefficients);
    if (batch->operators)
      memset(work.cell_tensor, 0, (int64_t)width * width * components * sizeof(double));
    for (int64_t piece = batch->offsets[k]; piece < batch->offsets[k + 1]; ++piece) {
      integrate_piece(sides, batch, integral, piece, local * local * components, &work);
      if (batch->operators)
        add_extracted(local, rows, columns, width, batch->operators + local * width * piece, &work);
    }
    int32_t n = 0;
    while (n < width && dofs[n] >= 0)
      ++n;
    const target into = {num_rows, indptr, (const char *)positions + starts[k] * position_size, position_size};
    const target usual = {num_rows, indptr, into.positions, 1};
    if (position_size == 1 && components == 1)
      add_rows(n, width, dofs, 1, 1, usual, tensor, values);
    else if (position_size == 1 && columns == 2)
      add_rows(n, width, dofs, rows, 2, usual, tensor, values);
    else if (position_size == 1 && columns == 3)
      add_rows(n, width, dofs, rows, 3, usual, tensor, values);
    else
      add_rows(n, width, dofs, rows, columns, into, tensor, values);
  }
  free(memory);
  return 0;
}

int thccs_assemble_matrix(const thccs_batch *batch, const thccs_integral *integral, int32_t rows, int32_t columns,
                          int32_t num_rows, const int32_t *indptr, const int64_t *starts, int32_t position_size,
                          const void *positions, double *values)
{
  return batch->sides == 1 ? assemble_matrix(1, batch, integral, rows, columns, num_rows, indptr, starts, position_size,
                                             positions, values)
                           : assemble_matrix(2, batch, integral, rows, columns, num_rows, indptr, starts, position_size,
                                             positions, values);
}

/* ---- Local problems -------------------------------------------------------------------------------------------- */

enum { BUBBLES = 4 }; /* of a cell: products of two polynomials along each side, the first along x fastest */

/* Values at the knots r, s, t of the polar forms of 3 x (1 - x)^2 and 3 x^2 (1 - x). */
static void continuous_bubbles(double r, double s, double t, double *values)
{
  const double sum = r + s + t, pairs = r * s + s * t + t * r, product = r * s * t;
  values[0] = sum - 2.0 * pairs + 3.0 * product;
  values[1] = pairs - 3.0 * product;
}

/* Of Hermite's cubics on [0, 1/2], 4 x^2 (3 - 4 x) with the value 1 at the end, and 4 x^2 (2 x - 1) with the slope 1;
   on [1/2, 1] their mirror images, so that both are C1. */
static void smooth_bubbles(int is_mirrored, double r, double s, double t, double *values)
{
  if (is_mirrored)
    r = 1.0 - r, s = 1.0 - s, t = 1.0 - t;
  const double pairs = r * s + s * t + t * r, product = r * s * t;
  values[0] = 4.0 * pairs - 16.0 * product;
  values[1] = (is_mirrored ? -1.0 : 1.0) * (8.0 * product - 4.0 / 3.0 * pairs);
}

/* Local B-spline coefficients (16, 4) of bubbles on a piece, which begins at origin in its cell and has edges u and v
   there, the columns of axes: one of them along x, the other along y. For smooth ones it lies in a quarter of it. */
static void bubbles_on_piece(int are_smooth, const double *origin, const double *axes, double *bubbles)
{
  double factors[2][4][2]; /* along x and along y */
  for (int d = 0; d < 2; ++d)
    for (int i = 0; i < 4; ++i) {
      /* Coefficient i is the polar form at the knots i - 2, i - 1 and i of the piece. */
      const double step = axes[2 * d] + axes[2 * d + 1], t = origin[d] + step * (i - 1);
      if (are_smooth)
        smooth_bubbles(origin[d] + step / 2.0 > 0.5, t + step, t - step, t, factors[d][i]);
      else
        continuous_bubbles(t + step, t - step, t, factors[d][i]);
    }
  const int is_turned = fabs(axes[1]) > fabs(axes[0]);
  for (int j = 0; j < 4; ++j)
    for (int i = 0; i < 4; ++i)
      for (int m = 0; m < BUBBLES; ++m)
        bubbles[(i + 4 * j) * BUBBLES + m] = factors[0][is_turned ? j : i][m % 2] * factors[1][is_turned ? i : j][m / 2];
}

/* residual (4, bs) += b^T tensor, and with coefficients (16, bs) for which tensor is a matrix: matrix (4, bs, 4, bs)
   += b^T tensor b and residual -= b^T tensor coefficients. */
INLINE void add_on_bubbles(int32_t bs, const double *restrict b, const double *restrict tensor,
                           const double *restrict coefficients, double *restrict matrix, double *restrict residual)
{
  for (int32_t i = 0; i < LOCAL; ++i)
    for (int32_t r = 0; r < bs; ++r) {
      double value = 0.0;
      if (!coefficients)
        value = tensor[i * bs + r];
      else
        for (int32_t c = 0; c < bs; ++c) {
          const double *row = tensor + (int64_t)(i * bs + r) * LOCAL * bs + c;
          double sum[BUBBLES] = {0.0};
          for (int32_t j = 0; j < LOCAL; ++j) {
            value -= row[j * bs] * coefficients[j * bs + c];
            for (int n = 0; n < BUBBLES; ++n)
              sum[n] += row[j * bs] * b[BUBBLES * j + n];
          }
          for (int m = 0; m < BUBBLES; ++m)
            for (int n = 0; n < BUBBLES; ++n)
              matrix[(m * bs + r) * BUBBLES * bs + n * bs + c] += b[BUBBLES * i + m] * sum[n];
        }
      for (int m = 0; m < BUBBLES; ++m)
        residual[m * bs + r] += b[BUBBLES * i + m] * value;
    }
}

/* B-spline coefficients (16, k) of a piece on one of its quarters, by knot insertion. */
static void cut(int quarter, int32_t k, const double *restrict in, double *restrict out)
{
  static const double HALVES[2][4][4] = {
      {{0.5, 0.5, 0.0, 0.0}, {0.125, 0.75, 0.125, 0.0}, {0.0, 0.5, 0.5, 0.0}, {0.0, 0.125, 0.75, 0.125}},
      {{0.125, 0.75, 0.125, 0.0}, {0.0, 0.5, 0.5, 0.0}, {0.0, 0.125, 0.75, 0.125}, {0.0, 0.0, 0.5, 0.5}}};
  for (int j = 0; j < 4; ++j)
    for (int i = 0; i < 4; ++i)
      for (int32_t c = 0; c < k; ++c) {
        double sum = 0.0;
        for (int b = 0; b < 4; ++b)
          for (int a = 0; a < 4; ++a)
            sum += HALVES[quarter / 2][j][b] * (HALVES[quarter % 2][i][a] * in[(a + 4 * b) * k + c]);
        out[(i + 4 * j) * k + c] = sum;
      }
}

/* Likewise all coefficients of an integral. Return the end of what was written. */
static double *cut_coefficients(const thccs_integral *integral, int quarter, const double *in, double *out)
{
  for (int32_t i = 0; i < integral->num_coefficients; ++i) {
    const int32_t bs = integral->coefficients[i].block_size;
    const int32_t size = integral->coefficients[i].is_cellwise ? bs : LOCAL * bs;
    if (integral->coefficients[i].is_cellwise)
      memcpy(out, in, size * sizeof(double));
    else if (integral->coefficients[i].values)
      cut(quarter, bs, in, out);
    in += size;
    out += size;
  }
  return out;
}

/* Add what `add_on_bubbles` adds, for the part of the cell that work->points map. */
INLINE void add_part(const thccs_integral *integral, int32_t bs, int are_smooth, const double *origin,
                     const double *axes, const double *own, const double *coefficients, workspace *work,
                     double *matrix, double *residual)
{
  double b[LOCAL * BUBBLES];
  bubbles_on_piece(are_smooth, origin, axes, b);
  integrate(integral, own, LOCAL * bs * (coefficients ? LOCAL * bs : 1), work);
  if (bs == 1)
    add_on_bubbles(1, b, work->piece_tensor, coefficients, matrix, residual);
  else
    add_on_bubbles(bs, b, work->piece_tensor, coefficients, matrix, residual);
}

/* Likewise for a piece that is a whole cell: smooth bubbles are polynomials in each of its quarters alone. */
INLINE void add_quarters(const thccs_integral *integral, int32_t bs, const double *origin, const double *axes,
                         const double *own, const double *coefficients, workspace *work, double *matrix,
                         double *residual)
{
  double points[3 * LOCAL];
  memcpy(points, work->points, sizeof points);
  for (int q = 0; q < 4; ++q) {
    double from[2], along[4];
    for (int d = 0; d < 2; ++d) {
      from[d] = origin[d] + (q % 2 * axes[2 * d] + q / 2 * axes[2 * d + 1]) / 2.0;
      along[2 * d] = axes[2 * d] / 2.0;
      along[2 * d + 1] = axes[2 * d + 1] / 2.0;
    }
    cut(q, 3, points, work->points);
    double *behind = cut_coefficients(integral, q, own, work->part_coefficients);
    if (coefficients)
      cut(q, bs, coefficients, behind);
    add_part(integral, bs, 1, from, along, work->part_coefficients, coefficients ? behind : NULL, work, matrix,
             residual);
  }
}

int thccs_assemble_on_bubbles(const thccs_batch *batch, const thccs_integral *integral, int32_t block_size,
                              int32_t are_smooth, const double *origins, const double *axes,
                              const double *coefficients, double *matrices, double *residuals)
{
  workspace work;
  const int32_t bs = block_size;
  const int64_t n = BUBBLES * bs;
  void *memory = make_workspace(&work, batch, integral, coefficients ? bs * bs : bs);
  if (!memory)
    return -1;
  for (int32_t i = 0; i < integral->num_cells; ++i) {
    const int32_t k = chosen(integral, i);
    double *matrix = matrices + n * n * batch->cells[k], *residual = residuals + n * batch->cells[k];
    gather_coefficients(1, batch, integral, k, work.cell_coefficients);
    for (int64_t piece = batch->offsets[k]; piece < batch->offsets[k + 1]; ++piece) {
      const double *origin = origins + 2 * piece, *axis = axes + 4 * piece;
      const double *own = load_piece(1, batch, integral, piece, &work);
      const double *c = coefficients ? coefficients + LOCAL * bs * piece : NULL;
      if (are_smooth && fabs(axis[0]) + fabs(axis[1]) > 0.75)
        add_quarters(integral, bs, origin, axis, own, c, &work, matrix, residual);
      else
        add_part(integral, bs, are_smooth, origin, axis, own, c, &work, matrix, residual);
    }
  }
  free(memory);
  return 0;
}

/* Pivots and remainders that are but rounding, where the largest entry of each row is 1. */
static const double SINGULAR = 1e-13, REMAINDER = 1e-10;

static void swap(double *a, double *b)
{
  const double c = *a;
  *a = *b;
  *b = c;
}

/* Make the largest entry of each row 1. Return the sum of the absolute right-hand sides then. */
static double scale_rows(int32_t n, double *a, double *b)
{
  double sum = 0.0;
  for (int32_t i = 0; i < n; ++i) {
    double largest = 0.0;
    for (int32_t j = 0; j < n; ++j)
      largest = fmax(largest, fabs(a[n * i + j]));
    if (largest > 0.0) {
      for (int32_t j = 0; j < n; ++j)
        a[n * i + j] /= largest;
      b[i] /= largest;
    }
    sum += fabs(b[i]);
  }
  return sum;
}

/* Bring the largest of the entries from (s, s) on there, and return its size. */
static double pivot(int32_t n, int32_t s, double *a, double *b, double *r)
{
  int32_t p = s, q = s;
  for (int32_t i = s; i < n; ++i)
    for (int32_t j = s; j < n; ++j)
      if (fabs(a[n * i + j]) > fabs(a[n * p + q]))
        p = i, q = j;
  for (int32_t j = 0; j < n; ++j)
    swap(a + n * s + j, a + n * p + j);
  for (int32_t i = 0; i < n; ++i)
    swap(a + n * i + s, a + n * i + q);
  swap(b + s, b + p);
  swap(r + s, r + q);
  return fabs(a[n * s + s]);
}

/* r^T z with a z = b: Gauss' elimination, rows and columns pivoted. All of a, b and r is written over. */
static double solved(int32_t n, double *a, double *b, double *r)
{
  const double scale = scale_rows(n, a, b);
  if (!isfinite(scale))
    return NAN;
  int32_t rank = 0;
  for (; rank < n && pivot(n, rank, a, b, r) > SINGULAR; ++rank)
    for (int32_t i = rank + 1; i < n; ++i) {
      const double factor = a[n * i + rank] / a[n * rank + rank];
      for (int32_t j = rank + 1; j < n; ++j)
        a[n * i + j] -= factor * a[n * rank + j];
      b[i] -= factor * b[rank];
    }
  for (int32_t i = rank; i < n; ++i)
    if (fabs(b[i]) > REMAINDER * scale)
      return INFINITY;
  double product = 0.0;
  for (int32_t i = rank - 1; i >= 0; --i) {
    for (int32_t j = i + 1; j < rank; ++j)
      b[i] -= a[n * i + j] * b[j];
    b[i] /= a[n * i + i];
    product += r[i] * b[i];
  }
  return product;
}

void thccs_solve_local(int32_t num_cells, int32_t n, double *matrices, double *residuals, double *again,
                       double *values)
{
  for (int64_t k = 0; k < num_cells; ++k)
    values[k] = solved(n, matrices + n * n * k, residuals + n * k, again + n * k);
}

/* ---- Sparsity pattern ------------------------------------------------------------------------------------------ */

void thccs_sparsity(int32_t num_dofs, const int32_t *restrict cell_offsets, const int32_t *restrict cell_dofs,
                    const int32_t *restrict dof_offsets, const int32_t *restrict dof_cells, int32_t *restrict seen,
                    int32_t *restrict next, int32_t *restrict indices)
{
  for (int32_t i = 0; i < num_dofs; ++i)
    for (int32_t c = dof_offsets[i]; c < dof_offsets[i + 1]; ++c)
      for (int32_t d = cell_offsets[dof_cells[c]]; d < cell_offsets[dof_cells[c] + 1]; ++d) {
        const int32_t j = cell_dofs[d];
        if (seen[j] == i)
          continue;
        seen[j] = i;
        /* The pattern is symmetric: as i increases, row j gets its columns in order. */
        if (indices)
          indices[next[j]] = i;
        ++next[j];
      }
}

void thccs_blocked_indices(int32_t num_dofs, int32_t rows, int32_t columns, const int32_t *restrict indptr,
                           const int32_t *restrict indices, int32_t *restrict blocked)
{
  for (int32_t i = 0; i < num_dofs; ++i)
    for (int32_t r = 0; r < rows; ++r)
      for (int32_t p = indptr[i]; p < indptr[i + 1]; ++p)
        for (int32_t c = 0; c < columns; ++c)
          *blocked++ = columns * indices[p] + c;
}

void thccs_positions(int32_t num_dofs, const int32_t *restrict cell_offsets, const int32_t *restrict cell_dofs,
                     const int32_t *restrict dof_offsets, const int32_t *restrict dof_cells,
                     const int32_t *restrict dof_locals, const int32_t *restrict indptr,
                     const int32_t *restrict indices, int32_t *restrict place, const int64_t *restrict starts,
                     int32_t position_size, void *restrict positions)
{
  uint8_t *narrow = positions;
  uint16_t *wide = positions;
  for (int32_t i = 0; i < num_dofs; ++i) {
    const int32_t begin = indptr[i], length = indptr[i + 1] - begin;
    for (int32_t p = 0; p < length; ++p)
      place[indices[begin + p]] = p;
    for (int32_t c = dof_offsets[i]; c < dof_offsets[i + 1]; ++c) {
      const int32_t cell = dof_cells[c], first = cell_offsets[cell], n = cell_offsets[cell + 1] - first;
      const int64_t start = starts[cell] + (int64_t)n * dof_locals[c];
      for (int32_t b = 0; b < n; ++b)
        if (position_size == 1)
          narrow[start + b] = (uint8_t)place[cell_dofs[first + b]];
        else
          wide[start + b] = (uint16_t)place[cell_dofs[first + b]];
    }
  }
}

void thccs_tabulate(thccs_kernel *kernel, int32_t n, int32_t num_values, int32_t num_coefficients,
                    const double *coefficients, const double *constants, const double *points, double *values) {
  for (int64_t k = 0; k < n; ++k)
    kernel(values + k * num_values, coefficients + k * num_coefficients, constants, points + k * 48, FACETS,
           PERMUTATIONS, NULL);
}

/* ---- Evaluation ------------------------------------------------------------------------------------------------ */

/* The cubic Bernstein polynomials at t, their first and their second derivatives. */
static void bernstein(double t, double b[3][4])
{
  const double s = 1.0 - t;
  const double values[3][4] = {{s * s * s, 3.0 * s * s * t, 3.0 * s * t * t, t * t * t},
                               {-3.0 * s * s, 3.0 * s * (s - 2.0 * t), 3.0 * t * (2.0 * s - t), 3.0 * t * t},
                               {6.0 * s, 6.0 * (t - 2.0 * s), 6.0 * (s - 2.0 * t), 6.0 * t}};
  memcpy(b, values, sizeof values);
}

/* Number of derivatives along u and along v of each row of the result. */
static const int ORDERS[6][2] = {{0, 0}, {1, 0}, {0, 1}, {2, 0}, {1, 1}, {0, 2}};

INLINE void evaluate_patches(int64_t n, const int32_t *patches, const double *uv, int32_t size,
                             const double *restrict coefficients, int rows, double *restrict out)
{
  for (int64_t p = 0; p < n; ++p) {
    const double *restrict c = coefficients + (int64_t)LOCAL * size * patches[p];
    double u[3][4], v[3][4];
    bernstein(uv[2 * p], u);
    bernstein(uv[2 * p + 1], v);
    for (int row = 0; row < rows; ++row) {
      const double *along_u = u[ORDERS[row][0]], *along_v = v[ORDERS[row][1]];
      double *to = out + (row * n + p) * size;
      for (int32_t k = 0; k < size; ++k) {
        double sum = 0.0;
        for (int j = 0; j < 4; ++j)
          for (int i = 0; i < 4; ++i)
            sum += along_v[j] * (along_u[i] * c[(i + 4 * j) * size + k]);
        to[k] = sum;
      }
    }
  }
}

void thccs_evaluate_patches(int64_t n, const int32_t *patches, const double *uv, int32_t size,
                            const double *coefficients, int32_t rows, double *out)
{
  /* The usual cases with their sizes known to the compiler. */
  if (size == 3 && rows == 3)
    evaluate_patches(n, patches, uv, 3, coefficients, 3, out);
  else if (size == 3 && rows == 1)
    evaluate_patches(n, patches, uv, 3, coefficients, 1, out);
  else
    evaluate_patches(n, patches, uv, size, coefficients, rows, out);
}

/* ---- Extraction ------------------------------------------------------------------------------------------------ */

static int ascending(const void *a, const void *b)
{
  const int32_t x = *(const int32_t *)a, y = *(const int32_t *)b;
  return (x > y) - (x < y);
}

void thccs_cell_columns(int32_t num_cells, const int32_t *cell_rows, const int32_t *rows, const int32_t *indptr,
                        const int32_t *indices, int32_t *seen, int32_t *offsets, int32_t *columns)
{
  int32_t end = 0;
  for (int32_t c = 0; c < num_cells; ++c) {
    const int32_t first = end;
    for (int32_t r = cell_rows[c]; r < cell_rows[c + 1]; ++r)
      for (int32_t k = indptr[rows[r]]; k < indptr[rows[r] + 1]; ++k)
        if (seen[indices[k]] != c) {
          seen[indices[k]] = c;
          columns[end++] = indices[k];
        }
    qsort(columns + first, end - first, sizeof *columns, ascending);
    offsets[c + 1] = end;
  }
}

void thccs_dense_rows(int32_t num_cells, const int32_t *cell_rows, const int32_t *rows, const int32_t *indptr,
                      const int32_t *indices, const double *data, const int32_t *offsets, const int32_t *columns,
                      const int32_t *width, const int64_t *starts, int32_t *place, double *values)
{
  for (int32_t c = 0; c < num_cells; ++c) {
    for (int32_t i = offsets[c]; i < offsets[c + 1]; ++i)
      place[columns[i]] = i - offsets[c];
    for (int32_t r = cell_rows[c]; r < cell_rows[c + 1]; ++r) {
      double *row = values + starts[c] + (int64_t)(r - cell_rows[c]) * width[c];
      for (int32_t k = indptr[rows[r]]; k < indptr[rows[r] + 1]; ++k)
        row[place[indices[k]]] = data[k];
    }
  }
}

/* ---- Sparse matrices ------------------------------------------------------------------------------------------- */

/* Sort a row by columns, equal ones in the order they have: rows are short. */
static void sort_row(int32_t n, int32_t *indices, double *data)
{
  for (int32_t k = 1; k < n; ++k) {
    const int32_t column = indices[k];
    const double value = data[k];
    int32_t j = k;
    for (; j > 0 && indices[j - 1] > column; --j) {
      indices[j] = indices[j - 1];
      data[j] = data[j - 1];
    }
    indices[j] = column;
    data[j] = value;
  }
}

void thccs_sum_triplets(int64_t n, const int32_t *rows, const int32_t *columns, const double *values,
                        int32_t num_rows, int32_t *indptr, int32_t *indices, double *data)
{
  /* Row i begins at indptr[i + 1] until its entries are there, and then ends there. */
  for (int64_t k = 0; k < n; ++k)
    if (rows[k] >= 0 && columns[k] >= 0 && rows[k] + 2 <= num_rows)
      ++indptr[rows[k] + 2];
  for (int32_t i = 2; i <= num_rows; ++i)
    indptr[i] += indptr[i - 1];
  for (int64_t k = 0; k < n; ++k)
    if (rows[k] >= 0 && columns[k] >= 0) {
      const int32_t to = indptr[rows[k] + 1]++;
      indices[to] = columns[k];
      data[to] = values[k];
    }
  int32_t size = 0;
  for (int32_t i = 0, begin = 0; i < num_rows; ++i) {
    const int32_t end = indptr[i + 1], first = size;
    sort_row(end - begin, indices + begin, data + begin);
    for (int32_t k = begin; k < end; ++k)
      if (size > first && indices[size - 1] == indices[k])
        data[size - 1] += data[k];
      else {
        indices[size] = indices[k];
        data[size++] = data[k];
      }
    indptr[i + 1] = size;
    begin = end;
  }
}

void thccs_product(int32_t num_rows, const int32_t *a_indptr, const int32_t *a_indices, const double *a_data,
                   const int32_t *b_indptr, const int32_t *b_indices, const double *b_data, const int32_t *unit,
                   int32_t *place, int32_t *indptr, int32_t *indices, double *data)
{
  int32_t size = 0;
  for (int32_t i = 0; i < num_rows; ++i) {
    const int32_t first = size;
    if (unit && unit[i] >= 0) {
      indices[size] = unit[i];
      data[size++] = 1.0;
    }
    const int32_t end = unit && unit[i] != -1 ? a_indptr[i] : a_indptr[i + 1];
    for (int32_t k = a_indptr[i]; k < end; ++k)
      for (int32_t m = b_indptr[a_indices[k]]; m < b_indptr[a_indices[k] + 1]; ++m) {
        const int32_t column = b_indices[m];
        if (place[column] < first) {
          place[column] = size;
          indices[size] = column;
          data[size++] = a_data[k] * b_data[m];
        } else
          data[place[column]] += a_data[k] * b_data[m];
      }
    int32_t kept = first;
    for (int32_t k = first; k < size; ++k) {
      place[indices[k]] = -1;
      if (data[k] != 0.0) {
        indices[kept] = indices[k];
        data[kept++] = data[k];
      }
    }
    size = kept;
    sort_row(size - first, indices + first, data + first);
    indptr[i + 1] = size;
  }
}

void thccs_rows(int32_t num_rows, const int32_t *rows, const int32_t *a_indptr, const int32_t *a_indices,
                const double *a_data, const int32_t *indptr, int32_t *indices, double *data)
{
  for (int32_t i = 0; i < num_rows; ++i) {
    const int32_t begin = a_indptr[rows[i]], size = indptr[i + 1] - indptr[i];
    memcpy(indices + indptr[i], a_indices + begin, size * sizeof *indices);
    memcpy(data + indptr[i], a_data + begin, size * sizeof *data);
  }
}

void thccs_restrict(int32_t num_rows, const int32_t *rows, const int32_t *place, const int32_t *a_indptr,
                    const int32_t *a_indices, const double *a_data, int32_t *indptr, int32_t *indices, double *data)
{
  int32_t size = 0;
  indptr[0] = 0;
  for (int32_t i = 0; i < num_rows; ++i) {
    for (int32_t k = a_indptr[rows[i]]; k < a_indptr[rows[i] + 1]; ++k) {
      const int32_t column = place[a_indices[k]];
      if (column >= 0) {
        indices[size] = column;
        data[size++] = a_data[k];
      }
    }
    indptr[i + 1] = size;
  }
}

void thccs_absolute_sums(int32_t num_rows, const int32_t *indptr, const int32_t *indices, const double *data,
                         double *of_rows, double *of_columns)
{
  for (int32_t i = 0; i < num_rows; ++i)
    for (int32_t k = indptr[i]; k < indptr[i + 1]; ++k) {
      of_rows[i] += fabs(data[k]);
      of_columns[indices[k]] += fabs(data[k]);
    }
}

void thccs_split_pattern(int32_t num_rows, int32_t num_owned, const int32_t *indptr, const int32_t *indices,
                         const int32_t *numbers, int32_t *own_indptr, int32_t *own_indices, int32_t *other_indptr,
                         int32_t *other_indices)
{
  int32_t own = 0, other = 0;
  own_indptr[0] = other_indptr[0] = 0;
  for (int32_t i = 0; i < num_rows; ++i) {
    for (int32_t k = indptr[i]; k < indptr[i + 1]; ++k)
      if (indices[k] < num_owned)
        own_indices[own++] = indices[k];
      else
        other_indices[other++] = numbers[indices[k] - num_owned];
    own_indptr[i + 1] = own;
    other_indptr[i + 1] = other;
  }
}

void thccs_split_values(int64_t n, int32_t num_owned, const int32_t *indices, const double *restrict values,
                        double *restrict own, double *restrict others)
{
  for (int64_t k = 0; k < n; ++k)
    if (indices[k] < num_owned)
      *own++ = values[k];
    else
      *others++ = values[k];
}
