/* Array capacities, the number type and the named tolerances of the kernel.
 *
 * Every capacity is a macro with a default, so all memory is static and its size is known at compile time. A build
 * overrides a capacity with -DDBK_MAX_...=N.
 */
#ifndef DBK_CONFIG_H
#define DBK_CONFIG_H

#ifdef DBK_DOUBLE
typedef double dbk_real;
#else
typedef float dbk_real;
#endif

#ifndef DBK_MAX_DOF
#define DBK_MAX_DOF 8 /* controlled joints */
#endif
#ifndef DBK_MAX_SPHERES
#define DBK_MAX_SPHERES 112 /* collision spheres of the robot */
#endif
#ifndef DBK_MAX_HELD
#define DBK_MAX_HELD 8 /* collision spheres of a held object */
#endif
#ifndef DBK_MAX_LINKS
#define DBK_MAX_LINKS 20 /* rigid links of the robot */
#endif
#ifndef DBK_MAX_PAIRS
#define DBK_MAX_PAIRS 96 /* link pairs checked for self-collision */
#endif
#ifndef DBK_MAX_OBSTACLES
#define DBK_MAX_OBSTACLES 512 /* a multiple of DBK_LANES; 48 is typical on a microcontroller */
#endif
#ifndef DBK_MAX_ROWS
#define DBK_MAX_ROWS 512 /* constraint rows in one step; a multiple of DBK_LANES */
#endif

#ifndef DBK_MAX_USER
#define DBK_MAX_USER 16 /* constraint rows supplied by the caller */
#endif

#ifndef DBK_MAX_CUTS
#define DBK_MAX_CUTS 64 /* linear constraints that approximate the speed limits */
#endif

#ifndef DBK_MAX_REVISITS
#define DBK_MAX_REVISITS 1024 /* groups of pairs that could reach h = 0 within one period */
#endif

#ifndef DBK_LANES
#define DBK_LANES 8 /* SIMD lanes, a power of two; 1 on a processor without SIMD. The results are the same. */
#endif
/* `count` rounded up to whole SIMD vectors */
#define DBK_PADDED(count) (((count) + DBK_LANES - 1) & ~(DBK_LANES - 1))
/* not a power of two, so that the arrays do not map to the same cache lines */
#define DBK_OBSTACLE_CAPACITY (DBK_MAX_OBSTACLES + 2 * DBK_LANES)
#define DBK_ALL_SPHERES (DBK_MAX_SPHERES + DBK_MAX_HELD)
/* loops over the spheres of a link run to the end of the last SIMD vector */
#define DBK_SPHERE_CAPACITY (DBK_ALL_SPHERES + DBK_LANES)
#define DBK_ALL_LINKS (DBK_MAX_LINKS + 1)           /* the robot's links and the held object */
#define DBK_ROW_CAPACITY (DBK_MAX_ROWS + DBK_LANES) /* loops over rows run to the end of the last SIMD vector */
#define DBK_MAX_SPANS (DBK_ALL_SPHERES + DBK_ALL_LINKS * 2 + DBK_MAX_PAIRS)
#define DBK_QP_DIM (DBK_MAX_DOF + 1) /* joints and one slack */
#define DBK_QP_MAX_ITERATIONS 80     /* of the active-set method; the step brakes if the QP reaches this limit */

/* Tolerances. Rows are normalised in joint space, so the tolerances of rows are in rad/s. */
#ifdef DBK_DOUBLE
#define DBK_QP_TOL 1e-11   /* the QP treats a row as satisfied if its violation is smaller */
#define DBK_QP_SHIFT 1e-10 /* the rows are tightened by this amount, so that the solution satisfies the original rows */
#define DBK_QP_DEPENDENT 1e-9 /* sine of the angle below which a normal counts as linearly dependent */
#define DBK_CHECK_TOL 1e-8    /* row violation that the independent check accepts */
#define DBK_CONTROL_ROUNDING 1e-15 /* rounding error of the second difference of the control, as a fraction of v_max */
#else
#define DBK_QP_TOL 2e-6f
#define DBK_QP_SHIFT 8e-6f
#define DBK_QP_DEPENDENT 1e-4f
#define DBK_CHECK_TOL 1e-4f
#define DBK_CONTROL_ROUNDING 4e-7f
#endif
#define DBK_RANK_TOL (DBK_QP_SHIFT * 4)    /* [rad/s] rounding allowance on the minimal violation of a rank */
#define DBK_VIOLATION_TOL ((dbk_real)1e-4) /* [m/s] a rank counts as relaxed if its violation is larger */
#define DBK_ZERO_GRADIENT ((dbk_real)1e-4) /* [m/rad] no joint can act on a row with a smaller normal */
#define DBK_MOUNT_ROUNDING ((dbk_real)1e-6) /* [m] rounding error of the distance of a pair that no joint moves */
#define DBK_RHS_ROUNDING ((dbk_real)1e-5)  /* [m/s] upper bound of the rounding error of a right side */
#define DBK_VELOCITY_ROUNDING ((dbk_real)4e-6) /* the same of a velocity, relative to angular velocity times position */
#define DBK_CULL_FLOOR ((dbk_real)1e-3)    /* [m] pairs closer than this are never culled */
#define DBK_MAX_DISTANCE ((dbk_real)10)    /* [m] larger than the reach of any supported robot */
/* [m] largest coordinate of the base and of an obstacle: beyond it the rounding of the base exceeds the margins */
#ifdef DBK_DOUBLE
#define DBK_MAX_BASE 1e9
#define DBK_MAX_POSITION 1e100
#else
#define DBK_MAX_BASE 1000.0f
#define DBK_MAX_POSITION 1000.0f
#endif
#define DBK_MAX_SIZE ((dbk_real)1e6)       /* [m], [m/s] largest size, margin and velocity error: squares are finite */
#define DBK_MAX_SPEED ((dbk_real)1000)     /* [m/s] largest velocity of an obstacle */
#define DBK_ROTATION_TOL ((dbk_real)1e-3)  /* error of a dot product between two axes of a rotation */
#define DBK_CLOCK_TOL ((dbk_real)0.005)    /* [s] a time stamp may be in the future by at most this */
#define DBK_SPEED_ROUNDING ((dbk_real)1e-4) /* fraction of a speed limit kept free for rounding errors */
#define DBK_SPEED_FLOOR ((dbk_real)5e-6)    /* [m/s] the same as a speed: the rounding error of a speed is below it */
#define DBK_SPEED_SHRINK ((dbk_real)1e-3)   /* a cut is closer than the limit by this fraction, so that cuts suffice */
#define DBK_SPEED_PERIODS ((dbk_real)4)     /* the growth of a speed at constant control is reserved for this time */
#define DBK_SPEED_ROUNDS 8                  /* QPs with cuts in one search, before the control moves toward braking */
#define DBK_TRUST_TRIES 3                  /* trust regions tried before the full control bounds are used */
#define DBK_TRUST_RADIUS ((dbk_real)0.02)  /* half width of the trust region as a fraction of v_max */
#define DBK_STOP_TRIES 8                   /* iterations for the approach to a position limit within the jerk limit */
#define DBK_LOST_COMMANDS ((dbk_real)3)    /* commands in a row that an arm with jerk limits may miss near v_max */
#define DBK_OUTSIDE_TOL ((dbk_real)0.2)    /* [rad] a state farther beyond a joint limit is rejected */

#endif
