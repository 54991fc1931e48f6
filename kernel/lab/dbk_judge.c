#include "dbk_judge.h"

#include <math.h>

#define FAR 1e3

static double norm3(const double a[3]) { return sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2]); }

static double apart(const double a[3], const double b[3]) {
  const double d[3] = {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
  return norm3(d);
}

void dbk_judge_centres(const dbk_judge_body *body, const double *q, double centre[DBK_JUDGE_SPHERES][3]) {
  double R[DBK_JUDGE_DOF + 1][3][3] = {{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}}, p[DBK_JUDGE_DOF + 1][3] = {{0, 0, 0}};
  for (int32_t k = 0; k < body->n; ++k) {
    const double c = cos(q[k]), s = sin(q[k]), *F = body->rotation[k];
    double turned[3][3]; /* fixed rotation times the turn about local z */
    for (int32_t i = 0; i < 3; ++i) {
      turned[i][0] = F[3 * i] * c + F[3 * i + 1] * s;
      turned[i][1] = -F[3 * i] * s + F[3 * i + 1] * c;
      turned[i][2] = F[3 * i + 2];
    }
    for (int32_t i = 0; i < 3; ++i) {
      p[k + 1][i] = p[k][i];
      for (int32_t j = 0; j < 3; ++j) {
        p[k + 1][i] += R[k][i][j] * body->offset[k][j];
        R[k + 1][i][j] = R[k][i][0] * turned[0][j] + R[k][i][1] * turned[1][j] + R[k][i][2] * turned[2][j];
      }
    }
  }
  for (int32_t l = 0; l < body->n_links; ++l) {
    const int32_t f = body->frame[l];
    for (int32_t s = body->first[l]; s < body->first[l + 1]; ++s) {
      const double *local = body->centre[s];
      for (int32_t i = 0; i < 3; ++i) {
        centre[s][i] = p[f][i] + (R[f][i][0] * local[0] + R[f][i][1] * local[1] + R[f][i][2] * local[2]);
      }
    }
  }
}

double dbk_thing_distance(const dbk_thing *thing, const double point[3]) {
  double local[3] = {0, 0, 0}, outside[3], deepest = -FAR;
  for (int32_t i = 0; i < 3; ++i) {
    for (int32_t j = 0; j < 3; ++j) { local[i] += thing->rotation[3 * j + i] * (point[j] - thing->position[j]); }
  }
  if (thing->shape == DBK_THING_PLANE) { return local[2]; }
  if (thing->shape == DBK_THING_CAPSULE) {
    const double beyond = fmax(fabs(local[2]) - thing->half[2], 0.0);
    return sqrt(local[0] * local[0] + local[1] * local[1] + beyond * beyond) - thing->radius;
  }
  for (int32_t i = 0; i < 3; ++i) {
    const double over = fabs(local[i]) - thing->half[i];
    outside[i] = fmax(over, 0.0);
    deepest = fmax(deepest, over);
  }
  return norm3(outside) + fmin(deepest, 0.0);
}

/* how fast sphere s moved toward the thing between two looks: displacement along the inward normal, by differences */
static double approach_of(const dbk_judge *judge, const dbk_thing *thing, int32_t s, double period) {
  const double step = 1e-6;
  double gradient[3], along = 0.0;
  for (int32_t i = 0; i < 3; ++i) {
    double plus[3] = {judge->at[s][0], judge->at[s][1], judge->at[s][2]};
    double minus[3] = {plus[0], plus[1], plus[2]};
    plus[i] += step;
    minus[i] -= step;
    gradient[i] = dbk_thing_distance(thing, plus) - dbk_thing_distance(thing, minus);
  }
  const double size = fmax(norm3(gradient), 1e-12);
  for (int32_t i = 0; i < 3; ++i) { along -= gradient[i] / size * (judge->at[s][i] - judge->was[s][i]); }
  return along / period;
}

static double link_gap(const dbk_judge_body *body, const dbk_judge *judge, const dbk_thing *thing, int32_t link,
                       double period, double *approach) {
  double least = FAR;
  for (int32_t s = body->first[link]; s < body->first[link + 1]; ++s) {
    const double h = dbk_thing_distance(thing, judge->at[s]) - body->radius[s];
    least = fmin(least, h);
    if (h < 0.0 && thing->moving) { *approach = fmax(*approach, approach_of(judge, thing, s, period)); }
  }
  return least;
}

static double pair_gap(const dbk_judge_body *body, const dbk_judge *judge, int32_t a, int32_t b) {
  double least = FAR;
  for (int32_t i = body->first[a]; i < body->first[a + 1]; ++i) {
    for (int32_t j = body->first[b]; j < body->first[b + 1]; ++j) {
      least = fmin(least, apart(judge->at[i], judge->at[j]) - body->radius[i] - body->radius[j]);
    }
  }
  return least;
}

void dbk_judge_reset(dbk_judge *judge) { judge->fresh = 1; }

/* how far the spheres of each link went since the last look */
static void travel(const dbk_judge_body *body, dbk_judge *judge, const double *q, double moved[DBK_JUDGE_LINKS]) {
  double next[DBK_JUDGE_SPHERES][3];
  dbk_judge_centres(body, q, next);
  for (int32_t l = 0; l < body->n_links; ++l) {
    moved[l] = 0.0;
    for (int32_t s = body->first[l]; s < body->first[l + 1]; ++s) {
      if (!judge->fresh) { moved[l] = fmax(moved[l], apart(next[s], judge->at[s])); }
      for (int32_t i = 0; i < 3; ++i) {
        judge->was[s][i] = judge->fresh ? next[s][i] : judge->at[s][i];
        judge->at[s][i] = next[s][i];
      }
    }
  }
}

void dbk_judge_look(const dbk_judge_body *body, dbk_judge *judge, const double *q, const dbk_thing *things,
                    int32_t n_things, double period, dbk_verdict *verdict) {
  double moved[DBK_JUDGE_LINKS];
  const double cap = judge->fresh ? FAR : DBK_JUDGE_NEAR;
  const dbk_verdict far = {cap, cap, cap, FAR, -FAR};
  *verdict = far;
  travel(body, judge, q, moved);
  for (int32_t o = 0; o < n_things; ++o) {
    const double shift = judge->fresh ? 0.0 : apart(things[o].position, judge->things[o]);
    double *least = things[o].moving ? &verdict->moving : &verdict->still;
    for (int32_t i = 0; i < 3; ++i) { judge->things[o][i] = things[o].position[i]; }
    for (int32_t l = 0; l < body->n_links; ++l) {
      if (body->frame[l] == 0) { continue; } /* the base is bolted down */
      double *slack = &judge->slack[l][o];
      *slack -= moved[l] + shift;
      if (!judge->fresh && *slack > DBK_JUDGE_NEAR) { continue; }
      *slack = link_gap(body, judge, &things[o], l, period, &verdict->approach);
      *least = fmin(*least, *slack);
    }
  }
  for (int32_t p = 0; p < body->n_pairs; ++p) {
    const int32_t a = body->pair[p][0], b = body->pair[p][1];
    judge->self_slack[p] -= moved[a] + moved[b];
    if (!judge->fresh && judge->self_slack[p] > DBK_JUDGE_NEAR) { continue; }
    judge->self_slack[p] = pair_gap(body, judge, a, b);
    verdict->self = fmin(verdict->self, judge->self_slack[p]);
  }
  for (int32_t k = 0; k < body->n; ++k) {
    verdict->joint = fmin(verdict->joint, fmin(q[k] - body->lower[k], body->upper[k] - q[k]));
  }
  judge->fresh = 0;
}
