/* dualbrain kernel: one step of a control barrier function (CBF) safety filter, in C99.
 *
 * The kernel uses no heap, no recursion, no global variables and no libm. The caller owns all memory: a step only reads
 * `model` and `scene`; `ctx` stores the previous control and the warm start. All values are in SI units. All
 * coordinates are in the robot's base frame with z up, or in the world frame if the base is mobile. The filter solves
 *
 *   min 1/2 (u - u_nom)' R (u - u_nom)   subject to   A u >= b,   lo <= u <= hi                   (paper 4.3)
 */
#ifndef DBK_H
#define DBK_H

#include <stdint.h>

#include "dbk/dbk_config.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef enum { DBK_SAFE, DBK_MODIFIED, DBK_RELAXED, DBK_STOPPED, DBK_FAULT } dbk_status;

/* reasons for the status of a step; several bits may be set */
enum {
  DBK_BAD_INPUT = 1,      /* an input value is not finite */
  DBK_STALE_STATE = 2,    /* the joint state is too old, or its time stamp is in the future */
  DBK_STALE_SCENE = 4,    /* the last observation of a moving obstacle is too old, or its stamp is in the future */
  DBK_OUTSIDE = 8,        /* a joint is far outside its limits */
  DBK_ROW_OVERFLOW = 16,  /* the row buffer is full */
  DBK_NO_GRADIENT = 32,   /* h < 0 for a pair that no joint can move */
  DBK_QP_ITERATIONS = 64, /* the QP reached its iteration limit */
  DBK_INFEASIBLE = 128,   /* no control within the bounds satisfies all rows */
  DBK_BAD_SCENE = 256,    /* the scene contains an invalid value */
  DBK_UNCERTIFIED = 512,  /* the next state would violate h >= 0, even under braking */
  DBK_UNAVOIDABLE = 1024, /* an obstacle moves toward a part of the robot that cannot move away */
  DBK_JERK = 2048,        /* information only: another limit has overridden the jerk limit in this step */
  DBK_UNVERIFIED = 4096,  /* the independent check rejected the solution of the QP; the result is nearer to braking */
  DBK_OVERSPEED = 8192,   /* no control was found that keeps the speed limits; no part is faster than its limit or,
                             if that is more, 0.4 % faster than under braking */
  DBK_RETREAT = 16384     /* every row that cannot be satisfied is of an obstacle that the robot evades in time */
};

enum { DBK_CAPSULE, DBK_BOX, DBK_HALF_SPACE }; /* obstacle shapes; a sphere is a capsule of length 0 */
enum { DBK_KNOWN = 1, DBK_STATIC = 2 };        /* obstacle flags; what has a velocity or an error of it moves anyway */
enum { DBK_ROW_OBSTACLE, DBK_ROW_SELF, DBK_ROW_LOWER, DBK_ROW_UPPER, DBK_ROW_USER, DBK_ROW_SPEED };
enum { DBK_REVOLUTE, DBK_PRISMATIC };
enum { DBK_LIMIT_VELOCITY, DBK_LIMIT_ACCELERATION, DBK_LIMIT_JERK, DBK_LIMIT_POSITION };

/* priority of a row in the relaxation, highest first; the control bounds and the speed limits are never relaxed */
enum { DBK_RANK_BODY = 1, DBK_RANK_OBSTACLE, DBK_RANK_WORKSPACE, DBK_RANK_TASK };

/* a bounding sphere of all collision spheres of a link; the centre is relative to the centre of the link's first
 * sphere, in the link's frame */
typedef struct {
  dbk_real x, y, z, radius;
  dbk_real inner_distance; /* min over spheres of |centre of the sphere - centre of the bounding sphere| - its radius */
  dbk_real centres_radius; /* max over spheres of |centre of the sphere - centre of the bounding sphere| */
} dbk_bounding_sphere;

typedef struct {
  int32_t n;                                /* joints */
  dbk_real period;                          /* control period [s] */
  dbk_real alpha, alpha_self, alpha_joint;  /* CBF gains of obstacles, self-collision and joint limits [1/s] */
  dbk_real recovery;                        /* maximum speed of the recovery from h < 0 [m/s] */
  dbk_real sampling, rounding, self_margin; /* margins for sampling, rounding and self-collision [m] */
  dbk_real lag;                             /* time constant of the drives [s]: y = q + lag v */
  dbk_real speed_limit;                     /* of every sphere centre and of the tool [m/s]; 0: no limit */
  int32_t moving_base;       /* 1: the first two joints are the drive and the turn of a base, which turns its drive axis */
  int32_t speed_first_joint; /* speeds are relative to frame speed_first_joint, such as that of a mobile base */
  dbk_real state_age_max, scene_age_max;    /* [s] */
  int32_t joint_kind[DBK_MAX_DOF]; /* a revolute joint rotates about its z axis, a prismatic one translates along it */
  dbk_real joint_rotation[DBK_MAX_DOF][9], joint_offset[DBK_MAX_DOF][3]; /* row-major; parent <- joint at q = 0 */
  dbk_real q_lower[DBK_MAX_DOF], q_upper[DBK_MAX_DOF], v_max[DBK_MAX_DOF], a_max[DBK_MAX_DOF];
  dbk_real j_max[DBK_MAX_DOF];              /* [rad/s^3]; 0: no limit */
  dbk_real tracking[DBK_MAX_DOF];           /* bound of the velocity tracking error of each joint [rad/s] */
  dbk_real scale[DBK_MAX_DOF][DBK_MAX_DOF]; /* S = L^-T with R = L L': u = u_nom + S x, cost |x|^2 / 2 */
  dbk_real tool_rotation[9], tool_offset[3];
  int32_t n_links, n_spheres, n_pairs, n_held_links;
  int32_t link_frame[DBK_MAX_LINKS], link_first[DBK_MAX_LINKS + 1]; /* the spheres of a link are contiguous */
  int32_t pair[DBK_MAX_PAIRS][2];                                   /* link pairs checked for self-collision */
  int32_t held_link[DBK_MAX_LINKS];                                 /* links checked against the held object */
  /* spheres in the frames of their links */
  dbk_real x[DBK_MAX_SPHERES], y[DBK_MAX_SPHERES], z[DBK_MAX_SPHERES], radius[DBK_MAX_SPHERES];
  /* displacement of a finger sphere per metre of gripper opening */
  dbk_real slide_x[DBK_MAX_SPHERES], slide_y[DBK_MAX_SPHERES], slide_z[DBK_MAX_SPHERES];
  /* computed by dbk_prepare */
  dbk_real reach[DBK_MAX_DOF][DBK_SPHERE_CAPACITY]; /* maximum lever arm of joint k on a sphere over all postures [m] */
  dbk_real link_reach[DBK_MAX_DOF][DBK_ALL_LINKS];  /* maximum over the spheres of a link */
  int32_t first_moved[DBK_MAX_DOF]; /* joint k moves no sphere before this one, the first of a SIMD vector */
  dbk_real tracking_max, tracking_share[DBK_MAX_DOF]; /* maximum of tracking, and tracking relative to it */
  dbk_real braking_gain, arc_share; /* 2 g [1/s] and 1/(2 g dt) with g = min a/v, see dbk_approach_speed */
  int32_t sphere_frame[DBK_ALL_SPHERES];
  dbk_bounding_sphere bounding_sphere[DBK_MAX_LINKS];
} dbk_model;

typedef struct {
  int32_t shape, flags, rank;
  uint32_t link_mask;                /* bit l: the obstacle constrains link l; bit n_links: the held object */
  dbk_real alpha;                    /* [1/s]; 0: the model's value */
  dbk_real position[3], rotation[9]; /* the columns of the rotation are the local axes */
  dbk_real half[3], radius;          /* half extents of a box; half[2] is the half length of a capsule */
  dbk_real velocity[3], margin, velocity_error;
  dbk_real reaction, brake, approach; /* speed and separation monitoring: reaction time [s], deceleration [m/s^2]
                                         (0: off), minimum assumed speed of the person [m/s] */
  /* power and force limiting: speed limit [m/s] (0: off) of the parts within a distance [m] of the obstacle, the
   * deceleration [m/s^2] to it outside, and the minimum assumed speed of the person [m/s] */
  dbk_real near_speed, near_distance, near_brake, near_approach;
} dbk_obstacle;

/* an enclosing capsule of each obstacle except half-spaces, as a structure of arrays: one SIMD loop tests a link
 * against all of them */
typedef struct {
  dbk_real x[DBK_OBSTACLE_CAPACITY], y[DBK_OBSTACLE_CAPACITY], z[DBK_OBSTACLE_CAPACITY];
  dbk_real ax[DBK_OBSTACLE_CAPACITY], ay[DBK_OBSTACLE_CAPACITY], az[DBK_OBSTACLE_CAPACITY];
  dbk_real half[DBK_OBSTACLE_CAPACITY], radius[DBK_OBSTACLE_CAPACITY];
  dbk_real margin[DBK_OBSTACLE_CAPACITY], alpha[DBK_OBSTACLE_CAPACITY];
  dbk_real vx[DBK_OBSTACLE_CAPACITY], vy[DBK_OBSTACLE_CAPACITY], vz[DBK_OBSTACLE_CAPACITY];
  dbk_real velocity_error[DBK_OBSTACLE_CAPACITY];
  dbk_real max_speed[DBK_OBSTACLE_CAPACITY]; /* |velocity| + velocity_error */
  uint32_t link_mask[DBK_OBSTACLE_CAPACITY]; /* 0 after the last obstacle */
  int32_t known[DBK_OBSTACLE_CAPACITY], moving[DBK_OBSTACLE_CAPACITY], rank[DBK_OBSTACLE_CAPACITY];
  int32_t plain[DBK_OBSTACLE_CAPACITY];         /* the obstacle is a capsule without speed and separation monitoring */
  int32_t static_sphere[DBK_OBSTACLE_CAPACITY]; /* the capsule has zero length, velocity and velocity error */
  int32_t any_half_space, any_separation, any_elongated, any_near;
} dbk_obstacle_capsules;

typedef struct {
  int32_t ready; /* set by dbk_scene_prepare */
  int32_t n_obstacles, n_held, moving;
  dbk_obstacle obstacle[DBK_MAX_OBSTACLES];
  dbk_real permit[DBK_ALL_LINKS][DBK_MAX_OBSTACLES]; /* maximum contact speed [m/s] if contact is permitted, else < 0 */
  /* spheres of the held object in the last frame of the chain, and their position error [m] */
  dbk_real held_x[DBK_MAX_HELD], held_y[DBK_MAX_HELD], held_z[DBK_MAX_HELD], held_r[DBK_MAX_HELD];
  dbk_real held_error;
  int32_t n_user, user_rank[DBK_MAX_USER];
  dbk_real user_a[DBK_MAX_USER][DBK_MAX_DOF], user_b[DBK_MAX_USER], user_h[DBK_MAX_USER]; /* a'u >= b */
  /* computed by dbk_scene_prepare */
  dbk_obstacle_capsules capsules;
  dbk_bounding_sphere held_bounding_sphere;
} dbk_scene;

typedef struct {
  dbk_real q[DBK_MAX_DOF], v[DBK_MAX_DOF], u_nom[DBK_MAX_DOF];
  dbk_real opening, state_age, scene_age;
  int32_t mobile; /* 0: the base frame is the world frame; 1: the pose of the base in the world frame follows */
  dbk_real base_rotation[9], base_position[3];
} dbk_in;

typedef struct {
  int32_t kind, i, j; /* obstacle row: sphere, obstacle; self row: sphere, sphere; bound: joint, DBK_LIMIT_...;
                         speed row: sphere (after the last one: the tool), cut; h is in m/s */
  dbk_real h, multiplier;
} dbk_active;

typedef struct {
  dbk_real u[DBK_MAX_DOF];
  dbk_real delta, delta_rows, delta_box;
  dbk_real h_min; /* NaN if the input was rejected */
  int32_t status, flags, certified, iterations, n_rows, n_active;
  int32_t relaxed;                   /* bit r: rows of rank r are partly violated */
  dbk_active active[DBK_QP_DIM + 1]; /* the active rows, or the conflicting rows if the step was relaxed */
} dbk_out;

/* the pair that the certificate rejected last: h now, and h at the next state */
typedef struct {
  int32_t kind, i, j; /* as in dbk_active */
  dbk_real h, next;
} dbk_rejected_pair;

/* frames of the kinematic chain: frame 0 is the base, frame i moves with joint i */
typedef struct {
  dbk_real rotation[DBK_MAX_DOF + 1][9], origin[DBK_MAX_DOF + 1][3];
} dbk_frames;

/* constraint rows as a structure of arrays with one column per joint, so that loops over rows vectorise. A span is a
 * run of rows that depend on the same joints span_first_joint..span_end_joint-1; it starts at row span_first. The rows
 * of a span come from batches of many spheres against one body (span_many_spheres = 1) or from batches of one sphere
 * against many bodies (0). In the first case (mx, my, mz) is the moment c x n, in the second case the centre c, with c
 * the centre of the row's sphere and n the normal */
typedef struct {
  int32_t count, overflow, no_gradient, unavoidable;
  int32_t fixed_kind, fixed_i, fixed_j; /* the last row that is unavoidable, with its h */
  dbk_real fixed_h;
  int32_t n_spans, span_first[DBK_MAX_SPANS], span_first_joint[DBK_MAX_SPANS], span_end_joint[DBK_MAX_SPANS];
  int32_t span_many_spheres[DBK_MAX_SPANS];
  dbk_real a[DBK_MAX_DOF][DBK_ROW_CAPACITY], b[DBK_ROW_CAPACITY]; /* normalised: |a| = 1 */
  dbk_real h[DBK_ROW_CAPACITY], norm[DBK_ROW_CAPACITY];           /* norm: of the row before the normalisation */
  dbk_real nx[DBK_ROW_CAPACITY], ny[DBK_ROW_CAPACITY], nz[DBK_ROW_CAPACITY];
  dbk_real mx[DBK_ROW_CAPACITY], my[DBK_ROW_CAPACITY], mz[DBK_ROW_CAPACITY];
  dbk_real soft[DBK_ROW_CAPACITY]; /* coefficient of the slack */
  int32_t kind[DBK_ROW_CAPACITY], i[DBK_ROW_CAPACITY], j[DBK_ROW_CAPACITY], moving[DBK_ROW_CAPACITY];
  int32_t clip[DBK_ROW_CAPACITY]; /* b is limited to the maximum of a'u over the control bounds, as for h < 0 */
  int32_t rank[DBK_ROW_CAPACITY];
} dbk_rows;

/* groups of pairs that could reach h = 0 within one period; the certificate evaluates them at the predicted state. A
 * group is a run of spheres and one other body: an obstacle (other >= 0) or a sphere (-1 - other) */
typedef struct {
  int32_t count;
  int16_t first_sphere[DBK_MAX_REVISITS], n_spheres[DBK_MAX_REVISITS], other[DBK_MAX_REVISITS];
} dbk_revisits;

/* A group of close pairs for self-collision: one sphere of the proximal link of a link pair, and the distal link. The next
 * step evaluates it first: its h is an upper bound of h_min, so that most other pairs can be culled. Every use checks
 * that the group exists in the model and the scene, so no event has to reset it */
typedef struct {
  int32_t link_pair; /* index in dbk_model.pair; after the last one: n_pairs + index in held_link; -1: none */
  int32_t sphere;
} dbk_nearest_links;

typedef struct {
  dbk_real x[DBK_SPHERE_CAPACITY], y[DBK_SPHERE_CAPACITY], z[DBK_SPHERE_CAPACITY], r[DBK_SPHERE_CAPACITY];
  int32_t count;
} dbk_sphere_set;

/* spatial velocity (angular w, linear v) about the base origin and its time derivative (dw, dv) at a constant control,
 * the centre of the control bounds; and the spatial velocity (tw, tv) at the centre of the trust region */
typedef struct {
  dbk_real w[3], v[3], dw[3], dv[3];
  dbk_real tw[3], tv[3];
} dbk_spatial;

/* motion of the collision spheres: velocities at the centre of the trust region, accelerations at the centre of the
 * control bounds, and bounds over all controls */
typedef struct {
  dbk_real vx[DBK_SPHERE_CAPACITY], vy[DBK_SPHERE_CAPACITY], vz[DBK_SPHERE_CAPACITY];
  dbk_real ax[DBK_SPHERE_CAPACITY], ay[DBK_SPHERE_CAPACITY], az[DBK_SPHERE_CAPACITY];
  dbk_real spread[DBK_SPHERE_CAPACITY]; /* maximum change of the velocity within the trust region [m/s] */
  /* per joint [rad/s] */
  dbk_real joint_max_speed[DBK_MAX_DOF];  /* maximum |u| within the trust region, plus the tracking error */
  dbk_real joint_half_width[DBK_MAX_DOF]; /* half width of the trust region, plus the tracking error */
  dbk_real joint_excess[DBK_MAX_DOF];     /* distance from the trust region to the farther control bound */
  dbk_spatial chain[DBK_MAX_DOF + 1];     /* of every frame */
  /* per link: bounding sphere at the current posture */
  dbk_real bound_x[DBK_ALL_LINKS], bound_y[DBK_ALL_LINKS], bound_z[DBK_ALL_LINKS], bound_r[DBK_ALL_LINKS];
  dbk_real inner_distance[DBK_ALL_LINKS], centres_radius[DBK_ALL_LINKS]; /* see dbk_bounding_sphere */
  /* per link: maximum over its spheres [m/s] */
  dbk_real trust_speed[DBK_ALL_LINKS];   /* maximum speed within the trust region */
  dbk_real max_speed[DBK_ALL_LINKS];     /* maximum speed within the control bounds */
  dbk_real sampling_term[DBK_ALL_LINKS]; /* dt/2 |acceleration| */
} dbk_sphere_motion;

/* Speed limits of one step. Point s < n_points - 1 is the centre of sphere s, the last point is the tool. A cut limits
 * the component of the velocity of a point along a unit vector; the cuts that were active remain for the next step */
typedef struct {
  int32_t active, n_points; /* active: 0 without any limit */
  dbk_real tool[3];
  dbk_real allowed[DBK_SPHERE_CAPACITY]; /* [m/s] */
  dbk_real limit[DBK_SPHERE_CAPACITY];   /* at the beginning of the period, such that `allowed` holds until its end */
  /* with jerk limits: the control gain u + shift after the acceleration is reduced to zero, and the limits for it */
  int32_t ramped;
  dbk_real gain[DBK_MAX_DOF], shift[DBK_MAX_DOF], ramp_limit[DBK_SPHERE_CAPACITY];
  int32_t n_cuts, cut_point[DBK_MAX_CUTS], cut_ramped[DBK_MAX_CUTS];
  dbk_real cut_x[DBK_MAX_CUTS], cut_y[DBK_MAX_CUTS], cut_z[DBK_MAX_CUTS];
} dbk_speed;

typedef struct {
  int32_t n, n_active, iterations, infeasible; /* infeasible: active[] and multiplier[] are the Farkas certificate */
  int32_t active[DBK_QP_DIM + 1];              /* 0..n-1 lower bounds, n..2n-1 upper bounds, 2n.. rows */
  dbk_real multiplier[DBK_QP_DIM + 1];
  dbk_real u[DBK_MAX_DOF], slack;
} dbk_solution;

typedef struct {
  dbk_real u_prev[DBK_MAX_DOF], u_nom_prev[DBK_MAX_DOF];
  dbk_real u_change[DBK_MAX_DOF];      /* u_prev minus the control before it */
  int32_t n_warm, warm[DBK_QP_DIM][3]; /* warm start: kind, i, j of the rows that were active in the previous step */
  dbk_nearest_links nearest;
  /* working memory of one step */
  dbk_frames frames;
  dbk_sphere_set spheres, next_spheres; /* at the current and at the predicted state */
  dbk_sphere_motion motion;
  dbk_rows rows;
  dbk_speed speed;
  dbk_revisits revisits;
  dbk_rejected_pair rejected_pair; /* valid after a step with the status DBK_FAULT */
  uint32_t narrow_phase_count; /* spheres tested against all spheres of another link */
  dbk_solution solution;
  dbk_real lower[DBK_MAX_DOF], upper[DBK_MAX_DOF], h_min;
  dbk_real trust_lower[DBK_MAX_DOF], trust_upper[DBK_MAX_DOF]; /* trust region: the rows cover only these controls */
  int32_t trust_active;                                        /* the trust region is smaller than the control bounds */
} dbk_ctx;

/* once per model, per change of the scene, and per episode */
void dbk_prepare(dbk_model *model);
void dbk_scene_prepare(dbk_scene *scene);
void dbk_scene_clear(dbk_scene *scene);
void dbk_init(dbk_ctx *ctx);

/* one control step: computes the safe control closest to u_nom. out->u is always finite and within the velocity and
 * acceleration bounds */
dbk_status dbk_step(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in, dbk_out *out);

/* adds the rows to ctx->rows that the last step omitted because its result could not violate them; `scene` and `in`
 * must be those of the last step */
void dbk_all_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in);

/* projects u_nom onto the rows of the known obstacles with `extra` clearance [m] and the bounds around u_prev. The
 * projection computes no certificate and does not change ctx->u_prev */
dbk_status dbk_project(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in,
                       const dbk_real u_prev[DBK_MAX_DOF], dbk_real extra, dbk_real u[DBK_MAX_DOF]);

#ifdef __cplusplus
}
#endif
#endif
