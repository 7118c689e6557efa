// The reference server: `mono ToyServer.exe RENDEZVOUS` serves one session over the toy plant and leaves.
// Build: mcs -optimize+ -out:ToyServer.exe ToyServer.cs Layout.cs Plant.cs ... (README.md has the whole line).

using System;
using System.Runtime.InteropServices;
using Word = TubeCosim.Layout.ParameterIndex;

namespace TubeCosim
{
    // One free body a lane under annex A's law, in semi-implicit Euler steps: the same plant as protocol/toy.py, bit
    // for bit, which is why the order of every sum and product is as it stands there. No walls, no gusts.
    public sealed class ToyPlant : IPlant
    {
        private double h;
        private int innerSteps;
        private double[][] parameters;

        public PlantDescription Describe()
        {
            return new PlantDescription
            {
                Name = "protocol.csharp",
                Version = "1",
                Engine = "semi-implicit Euler",
                SpeedMax = 10.0,
                Defaults = new[]
                {
                    1.0, 0.01, 0.01, 0.02, 0.15, // mass, inertia, body radius
                    8.0, 0.0, 120.0, 18.0, // gains of force and torque
                    0.0, 0.0, 9.81, // drag, gravity
                    0.2, 0.5, // restitution, friction
                    0.0, 0.0, 0.0, 0.0, // disturbance, gust
                },
            };
        }

        public void Open(int lanes, double dt, double physicsDt, int innerSteps)
        {
            this.innerSteps = innerSteps;
            h = dt / innerSteps;
            parameters = new double[lanes][];
        }

        public void RegisterTube(int index, TubeReference tube)
        {
        }

        public void ReleaseTube(int index)
        {
        }

        public void Reset(LaneReset[] resets, LanePose[] poses)
        {
            foreach (LaneReset reset in resets)
            {
                double gust = reset.Parameters[Word.Gust];
                if (gust != 0.0)
                    throw new Refusal("gust", "0, since this plant has no gusts", Format.Of(gust), reset.Lane);
            }
            foreach (LaneReset reset in resets)
            {
                parameters[reset.Lane] = reset.Parameters;
                poses[reset.Lane] = reset.Pose;
            }
        }

        public void Step(LaneCommand[] commands, LanePose[] poses)
        {
            for (int lane = 0; lane < commands.Length; lane++)
                for (int i = 0; i < innerSteps; i++)
                    InnerStep(ref poses[lane], ref commands[lane], parameters[lane], h);
        }

        public void Close()
        {
        }

        // Advances one body by h seconds; force and torque are those of the state at the beginning.
        public static void InnerStep(ref LanePose pose, ref LaneCommand command, double[] parameters, double h)
        {
            double x = pose.Rotation.X, y = pose.Rotation.Y, z = pose.Rotation.Z, w = pose.Rotation.W;
            Vector3d forward = new Vector3d(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y));
            Vector3d left = new Vector3d(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x));
            Vector3d up = new Vector3d(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
            Vector3d velocity = Accelerated(pose.LinearVelocity, forward, ref command, parameters, h);
            Vector3d spin = Turned(pose.AngularVelocity, forward, left, up, command.Direction, parameters, h);

            double half = 0.5 * h; // q' = q + h/2 (omega, 0) q
            double x1 = x + half * (spin.X * w + spin.Y * z - spin.Z * y);
            double y1 = y + half * (spin.Y * w + spin.Z * x - spin.X * z);
            double z1 = z + half * (spin.Z * w + spin.X * y - spin.Y * x);
            double w1 = w - half * (spin.X * x + spin.Y * y + spin.Z * z);
            double norm = Math.Sqrt(x1 * x1 + y1 * y1 + z1 * z1 + w1 * w1);
            pose.Position.X = pose.Position.X + h * velocity.X;
            pose.Position.Y = pose.Position.Y + h * velocity.Y;
            pose.Position.Z = pose.Position.Z + h * velocity.Z;
            pose.Rotation = new Quaterniond(x1 / norm, y1 / norm, z1 / norm, w1 / norm);
            pose.LinearVelocity = velocity;
            pose.AngularVelocity = spin;
        }

        private static Vector3d Accelerated(Vector3d v, Vector3d forward, ref LaneCommand command, double[] p,
            double h)
        {
            double mass = p[Word.Mass], drag = p[Word.LinearDrag];
            double gravity = p[Word.Gravity], speed = command.Speed;
            Vector3d a = p[Word.ForceAlongBody] != 0.0 ? forward : command.Direction;
            double thrust = mass * p[Word.ForceGain];
            double lift = command.Compensation * mass * gravity;
            return new Vector3d(
                v.X + h * ((thrust * (speed * a.X - v.X) - drag * v.X + p[Word.DisturbanceX])
                    / mass),
                v.Y + h * ((thrust * (speed * a.Y - v.Y) - drag * v.Y + p[Word.DisturbanceY])
                    / mass),
                v.Z + h * ((thrust * (speed * a.Z - v.Z) + lift - drag * v.Z
                    + p[Word.DisturbanceZ]) / mass - gravity));
        }

        // In the body frame f = (1, 0, 0), so f x d = (0, -d_up, d_left), and the inertia is diagonal.
        private static Vector3d Turned(Vector3d o, Vector3d forward, Vector3d left, Vector3d up, Vector3d d,
            double[] p, double h)
        {
            double ix = p[Word.InertiaX], iy = p[Word.InertiaY];
            double iz = p[Word.InertiaZ], drag = p[Word.AngularDrag];
            double kp = p[Word.TorqueKp], kd = p[Word.TorqueKd];
            double bx = Vector3d.Dot(forward, o), by = Vector3d.Dot(left, o), bz = Vector3d.Dot(up, o);
            double tx = ix * (-kd * bx) - drag * bx;
            double ty = iy * (kp * -Vector3d.Dot(up, d) - kd * by) - drag * by;
            double tz = iz * (kp * Vector3d.Dot(left, d) - kd * bz) - drag * bz;
            double gx = (tx - (iz - iy) * by * bz) / ix;
            double gy = (ty - (ix - iz) * bz * bx) / iy;
            double gz = (tz - (iy - ix) * bx * by) / iz;
            return new Vector3d(
                o.X + h * (forward.X * gx + left.X * gy + up.X * gz),
                o.Y + h * (forward.Y * gx + left.Y * gy + up.Y * gz),
                o.Z + h * (forward.Z * gx + left.Z * gy + up.Z * gz));
        }
    }

    public static class ToyServer
    {
        private const double AttachTimeoutS = 30.0;
        private const int Usage = 2, Failed = 3;

        public static int Main(string[] arguments)
        {
            if (arguments.Length == 0)
            {
                Console.Error.WriteLine("usage: ToyServer.exe shm:NAME | file:/path/stem");
                return Usage;
            }
            Signals.Catch();
            try
            {
                PhysicsPeer.Serve(arguments[arguments.Length - 1], new ToyPlant(), AttachTimeoutS,
                    Signals.WhyToStop);
                return 0;
            }
            catch (ProtocolException error)
            {
                Console.Error.WriteLine(error.GetType().Name + ": " + error.Message);
                return Failed;
            }
        }
    }

    // Requests to stop: Mono's own helper counts signals in native code, as Console.CancelKeyPress does not without a
    // terminal. Where there is no such helper, a signal ends the process at once, which the agent sees as well.
    internal static class Signals
    {
        private static readonly int[] Numbers = { 1, 2, 15 }; // SIGHUP, SIGINT, SIGTERM
        private const int CountAt = 4;
        private static readonly IntPtr[] Counters = new IntPtr[Numbers.Length];

        [DllImport("MonoPosixHelper", EntryPoint = "Mono_Unix_UnixSignal_install")]
        private static extern IntPtr Install(int number);

        public static void Catch()
        {
            try
            {
                for (int i = 0; i < Numbers.Length; i++)
                    Counters[i] = Install(Numbers[i]);
            }
            catch (Exception error) when (error is DllNotFoundException || error is EntryPointNotFoundException)
            {
                Console.Error.WriteLine("signals are not caught: " + error.Message);
            }
        }

        public static string WhyToStop()
        {
            for (int i = 0; i < Counters.Length; i++)
                if (Counters[i] != IntPtr.Zero && Marshal.ReadInt32(Counters[i], CountAt) > 0)
                    return "it was told to stop (signal " + Format.Of(Numbers[i]) + ")";
            return null;
        }
    }
}
