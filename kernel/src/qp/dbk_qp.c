/* Dual active-set method (Goldfarb and Idnani 1983) for
 *
 *   min 1/2 |x|^2,   u = u_nom + S x,   A u + soft * slack >= b,   lo <= u <= hi.
 *
 * The normals of the active constraints are stored as N = T' Q with orthonormal Q (Gram-Schmidt with one
 * reorthogonalisation) and upper triangular T, so that a float32 solution remains accurate with nearly parallel rows.
 * The iteration starts from the unconstrained optimum, or from the warm-start active set after constraints with
 * negative multipliers are removed. Each iteration adds the most violated constraint. If a violated constraint depends
 * linearly on the active ones and none of them can leave, the multipliers are a Farkas certificate: no control
 * satisfies all constraints.
 */
#include "qp/dbk_qp.h"

typedef struct {
  const dbk_rows *rows;
  const dbk_real (*scale)[DBK_MAX_DOF];
  const dbk_real *lower, *upper;
  int32_t n, dim; /* joints; joints and slack */
  dbk_real shift;
} problem;

typedef struct {
  int32_t count, id[DBK_QP_DIM];
  dbk_real q[DBK_QP_DIM][DBK_QP_DIM]; /* orthonormal directions */
  dbk_real t[DBK_QP_DIM][DBK_QP_DIM]; /* t[j][i]: component of normal i along direction j, j <= i */
  dbk_real multiplier[DBK_QP_DIM];
} active_set;

/* number of the row of constraint id >= 2 n */
static inline int32_t row_of(const problem *p, int32_t id) { return dbk_bounded(id - 2 * p->n, DBK_MAX_ROWS - 1); }

/* number of the joint of constraint id < 2 n */
static inline int32_t joint_of(const problem *p, int32_t id) {
  return dbk_bounded(id < p->n ? id : id - p->n, DBK_MAX_DOF - 1);
}

/* Computes the normal in x coordinates (S' a, soft) and returns the right side of one constraint. The loops read all
 * DBK_MAX_DOF columns of S, which are zero after the last joint. */
static dbk_real constraint(const problem *p, int32_t id, dbk_real normal[DBK_QP_DIM]) {
  const int32_t n = p->n;
  normal[DBK_MAX_DOF] = (dbk_real)0;
  /* a lower or upper bound */
  if (id < 2 * n) {
    const int32_t joint = joint_of(p, id);
    const dbk_real sign = id < n ? (dbk_real)1 : (dbk_real)-1;
    for (int32_t k = 0; k < DBK_MAX_DOF; ++k) { normal[k] = sign * p->scale[joint][k]; }
    if (p->dim > n) { normal[n] = (dbk_real)0; }
    return id < n ? p->lower[joint] : -p->upper[joint];
  }
  /* a row */
  const int32_t r = row_of(p, id);
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) { normal[k] = (dbk_real)0; }
  for (int32_t i = 0; i < n; ++i) {
    const dbk_real a = p->rows->a[i][r];
    for (int32_t k = 0; k < DBK_MAX_DOF; ++k) { normal[k] += a * p->scale[i][k]; }
  }
  if (p->dim > n) { normal[n] = p->rows->soft[r]; }
  return p->rows->b[r] + p->shift;
}

/* left side minus right side of a constraint at u */
static dbk_real residual(const problem *p, int32_t id, const dbk_real *u, dbk_real slack) {
  const int32_t n = p->n;
  if (id < 2 * n) {
    const int32_t joint = joint_of(p, id);
    return id < n ? u[joint] - p->lower[joint] : p->upper[joint] - u[joint];
  }
  const int32_t r = row_of(p, id);
  dbk_real value = -(p->rows->b[r] + p->shift);
  for (int32_t k = 0; k < n; ++k) { value += p->rows->a[k][r] * u[k]; }
  return p->dim > n ? value + p->rows->soft[r] * slack : value;
}

/* splits a normal into its components `along` Q and the orthogonal `rest`; returns the squared length of the rest */
static dbk_real split(const active_set *s, int32_t dim, const dbk_real *normal, dbk_real *along, dbk_real *rest) {
  for (int32_t k = 0; k < dim; ++k) { rest[k] = normal[k]; }
  for (int32_t j = 0; j < s->count; ++j) { along[j] = (dbk_real)0; }
  for (int32_t pass = 0; pass < 2; ++pass) {
    for (int32_t j = 0; j < s->count; ++j) {
      dbk_real dot = (dbk_real)0;
      for (int32_t k = 0; k < dim; ++k) { dot += s->q[j][k] * rest[k]; }
      for (int32_t k = 0; k < dim; ++k) { rest[k] -= dot * s->q[j][k]; }
      along[j] += dot;
    }
  }
  dbk_real square = (dbk_real)0;
  for (int32_t k = 0; k < dim; ++k) { square += rest[k] * rest[k]; }
  return square;
}

static dbk_real square_of(const dbk_real *x, int32_t dim) {
  dbk_real square = (dbk_real)0;
  for (int32_t k = 0; k < dim; ++k) { square += x[k] * x[k]; }
  return square;
}

/* compares the squared lengths of the orthogonal rest and of the whole normal */
static int32_t independent(dbk_real rest, dbk_real whole) { return rest > DBK_QP_DEPENDENT * DBK_QP_DEPENDENT * whole; }

/* adds a constraint to the factorisation */
static void append(active_set *s, int32_t dim, int32_t id, const dbk_real *along, const dbk_real *rest, dbk_real square,
                   dbk_real multiplier) {
  const int32_t at = s->count;
  if (at >= dim || at >= DBK_QP_DIM) { return; }
  const dbk_real length = dbk_sqrt(square);
  for (int32_t j = 0; j < at; ++j) { s->t[j][at] = along[j]; }
  s->t[at][at] = length;
  for (int32_t k = 0; k < dim; ++k) { s->q[at][k] = rest[k] / length; }
  s->id[at] = id;
  s->multiplier[at] = multiplier;
  s->count = at + 1;
}

/* Recomputes the factorisation without member `removed` (-1: of all members). The members before it keep their
 * directions, which do not depend on later members. */
static void refactor(const problem *p, active_set *s, int32_t removed) {
  const int32_t members = s->count;
  s->count = removed < 0 ? 0 : removed;
  for (int32_t i = removed < 0 ? 0 : removed + 1; i < members; ++i) { /* append writes only to members that have already been read */
    const int32_t id = s->id[i];
    const dbk_real multiplier = s->multiplier[i];
    dbk_real normal[DBK_QP_DIM], along[DBK_QP_DIM], rest[DBK_QP_DIM];
    (void)constraint(p, id, normal);
    const dbk_real square = split(s, p->dim, normal, along, rest);
    if (independent(square, square_of(normal, p->dim))) { append(s, p->dim, id, along, rest, square, multiplier); }
  }
}

/* solves T r = along */
static void back_solve(const active_set *s, const dbk_real *along, dbk_real *r) {
  for (int32_t i = s->count - 1; i >= 0; --i) {
    dbk_real value = along[i];
    for (int32_t j = i + 1; j < s->count; ++j) { value -= s->t[i][j] * r[j]; }
    r[i] = value / s->t[i][i];
  }
}

/* u += step * S z, slack += step * z_n */
static void advance(const problem *p, dbk_real step, const dbk_real *z, dbk_solution *out) {
  for (int32_t i = 0; i < p->n; ++i) {
    dbk_real value = (dbk_real)0;
    for (int32_t k = 0; k < p->n; ++k) { value += p->scale[i][k] * z[k]; }
    out->u[i] += step * value;
  }
  if (p->dim > p->n) { out->slack += step * z[p->n]; }
}

/* the minimiser with the active set as equality constraints: T' y = b - N u_nom, x = Q' y, T multiplier = y */
static void solve_equalities(const problem *p, const dbk_real *u_nom, active_set *s, dbk_real *x) {
  dbk_real y[DBK_QP_DIM];
  for (int32_t k = 0; k < p->dim; ++k) { x[k] = (dbk_real)0; }
  for (int32_t i = 0; i < s->count; ++i) {
    dbk_real value = -residual(p, s->id[i], u_nom, (dbk_real)0);
    for (int32_t j = 0; j < i; ++j) { value -= s->t[j][i] * y[j]; }
    y[i] = value / s->t[i][i];
    for (int32_t k = 0; k < p->dim; ++k) { x[k] += y[i] * s->q[i][k]; }
  }
  back_solve(s, y, s->multiplier);
}

/* starts from the warm-start active set: the member with the most negative multiplier is removed until all are
 * positive */
static void warm_start(const problem *p, const dbk_real *u_nom, const int32_t *warm, int32_t n_warm, active_set *s,
                       dbk_solution *out) {
  dbk_real x[DBK_QP_DIM];
  s->count = 0;
  for (int32_t i = 0; i < n_warm && i < p->n; ++i) {
    s->id[s->count] = warm[i];
    s->multiplier[s->count] = (dbk_real)0;
    ++s->count;
  }
  if (s->count == 0) { return; }
  refactor(p, s, -1);
  for (int32_t pass = 0; pass <= DBK_QP_DIM; ++pass) {
    int32_t worst = -1;
    solve_equalities(p, u_nom, s, x);
    for (int32_t i = 0; i < s->count; ++i) {
      if (!(s->multiplier[i] > (dbk_real)0) && (worst < 0 || s->multiplier[i] < s->multiplier[worst])) { worst = i; }
    }
    if (worst < 0) { break; }
    refactor(p, s, worst);
  }
  if (s->count > 0) { advance(p, (dbk_real)1, x, out); }
}

/* id of the most violated constraint, or -1 */
static int32_t most_violated(const problem *p, const dbk_solution *at) {
  const int32_t n = p->n, count = p->rows->count;
  const int32_t padded = (count + DBK_LANES - 1) / DBK_LANES * DBK_LANES;
  dbk_real value[DBK_MAX_ROWS], low[DBK_LANES];
  dbk_real worst = -DBK_QP_TOL;
  int32_t id = -1;
  /* the bounds */
  for (int32_t k = 0; k < n; ++k) {
    const dbk_real below = at->u[k] - p->lower[k], above = p->upper[k] - at->u[k];
    if (below < worst) {
      worst = below;
      id = k;
    }
    if (above < worst) {
      worst = above;
      id = n + k;
    }
  }
  if (count == 0) { return id; }
  /* the residuals of all rows, column by column */
  const dbk_real *restrict b = p->rows->b;
  for (int32_t r = 0; r < padded; ++r) { value[r] = -(b[r] + p->shift); }
  for (int32_t k = 0; k < n; ++k) {
    const dbk_real *restrict a = p->rows->a[k];
    const dbk_real u = at->u[k];
    for (int32_t r = 0; r < padded; ++r) { value[r] += a[r] * u; }
  }
  if (p->dim > n) {
    for (int32_t r = 0; r < padded; ++r) { value[r] += p->rows->soft[r] * at->slack; }
  }
  /* the smallest residual, and the first row that has it */
  for (int32_t l = 0; l < DBK_LANES; ++l) { low[l] = value[l]; }
  for (int32_t r = DBK_LANES; r < padded; r += DBK_LANES) {
    for (int32_t l = 0; l < DBK_LANES; ++l) { low[l] = value[r + l] < low[l] ? value[r + l] : low[l]; }
  }
  const dbk_real least = dbk_min_lanes(low, worst);
  if (least < worst) {
    for (int32_t r = 0; r < count; ++r) {
      if (value[r] == least) { return 2 * n + r; }
    }
  }
  return id;
}

static void store_active(const active_set *s, dbk_solution *out) {
  out->n_active = s->count;
  for (int32_t i = 0; i < s->count; ++i) {
    out->active[i] = s->id[i];
    out->multiplier[i] = s->multiplier[i];
  }
}

/* moves one violated constraint to its bound. Returns 0: done, 1: infeasible, 2: iteration limit */
static int32_t add_constraint(const problem *p, int32_t id, active_set *s, dbk_solution *out) {
  dbk_real normal[DBK_QP_DIM], along[DBK_QP_DIM], rest[DBK_QP_DIM], r[DBK_QP_DIM];
  const dbk_real infinity = (dbk_real)1e30;
  dbk_real multiplier = (dbk_real)0; /* of the added constraint */
  (void)constraint(p, id, normal);
  const dbk_real whole = square_of(normal, p->dim);
  for (; out->iterations < DBK_QP_MAX_ITERATIONS; ++out->iterations) {
    const dbk_real square = split(s, p->dim, normal, along, rest);
    const dbk_real missing = -residual(p, id, out->u, out->slack);
    back_solve(s, along, r);
    /* dual step: until the multiplier of an active constraint reaches zero */
    dbk_real dual = infinity, primal = infinity;
    int32_t leaves = -1;
    for (int32_t i = 0; i < s->count; ++i) {
      if (r[i] > (dbk_real)0 && s->multiplier[i] < dual * r[i]) {
        dual = s->multiplier[i] / r[i];
        leaves = i;
      }
    }
    /* primal step: until the constraint is satisfied */
    if (s->count < p->dim && independent(square, whole)) { primal = missing / square; }
    /* neither step exists: the multipliers of the active set and of this constraint are a Farkas certificate */
    if (leaves < 0 && !(primal < infinity)) {
      for (int32_t i = 0; i < s->count; ++i) { s->multiplier[i] = -r[i]; }
      store_active(s, out);
      if (out->n_active < DBK_QP_DIM + 1) {
        out->active[out->n_active] = id;
        out->multiplier[out->n_active] = (dbk_real)1;
        ++out->n_active;
      }
      out->infeasible = 1;
      return 1;
    }
    const dbk_real step = dbk_min(dual, primal);
    if (primal < infinity) { advance(p, step, rest, out); }
    for (int32_t i = 0; i < s->count; ++i) { s->multiplier[i] -= step * r[i]; }
    multiplier += step;
    /* a full step satisfies the constraint; a partial step removes a constraint from the active set */
    if (primal <= dual) {
      append(s, p->dim, id, along, rest, square, multiplier);
      ++out->iterations;
      return 0;
    }
    refactor(p, s, leaves);
  }
  return 2;
}

int32_t dbk_qp(const dbk_rows *rows, int32_t n, const dbk_real scale[DBK_MAX_DOF][DBK_MAX_DOF],
               const dbk_real lower[DBK_MAX_DOF], const dbk_real upper[DBK_MAX_DOF], const dbk_real u_nom[DBK_MAX_DOF],
               int32_t with_slack, dbk_real shift, const int32_t *warm, int32_t n_warm, dbk_solution *solution) {
  const problem p = {rows, scale, lower, upper, n, with_slack ? n + 1 : n, shift};
  active_set s;
  int32_t result = 2;
  s.count = 0;
  solution->n = n;
  solution->n_active = solution->iterations = solution->infeasible = 0;
  solution->slack = (dbk_real)0;
  for (int32_t k = 0; k < n; ++k) { solution->u[k] = u_nom[k]; }
  warm_start(&p, u_nom, warm, n_warm, &s, solution);
  while (solution->iterations < DBK_QP_MAX_ITERATIONS) {
    const int32_t id = most_violated(&p, solution);
    if (id < 0) {
      store_active(&s, solution);
      return 0;
    }
    result = add_constraint(&p, id, &s, solution);
    if (result != 0) { return result; }
  }
  store_active(&s, solution);
  return 2;
}
