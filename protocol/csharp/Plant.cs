// What travels between the two sides, and the contract of whatever integrates it: implement IPlant.
// World frame right-handed, Z up; metres, seconds, radians, kilograms, newtons; quaternions x, y, z, w, body to
// world. Body frame: x forward, y left, z up. Frames.cs converts to Unity's frame and back.

using System;
using System.Globalization;

namespace TubeCosim
{
    public struct Vector3d
    {
        public double X, Y, Z;

        public Vector3d(double x, double y, double z)
        {
            X = x;
            Y = y;
            Z = z;
        }

        public static Vector3d operator +(Vector3d a, Vector3d b)
        {
            return new Vector3d(a.X + b.X, a.Y + b.Y, a.Z + b.Z);
        }

        public static Vector3d operator -(Vector3d a, Vector3d b)
        {
            return new Vector3d(a.X - b.X, a.Y - b.Y, a.Z - b.Z);
        }

        public static Vector3d operator *(double k, Vector3d a)
        {
            return new Vector3d(k * a.X, k * a.Y, k * a.Z);
        }

        public static double Dot(Vector3d a, Vector3d b)
        {
            return a.X * b.X + a.Y * b.Y + a.Z * b.Z;
        }

        public static Vector3d Cross(Vector3d a, Vector3d b)
        {
            return new Vector3d(a.Y * b.Z - a.Z * b.Y, a.Z * b.X - a.X * b.Z, a.X * b.Y - a.Y * b.X);
        }
    }

    public struct Quaterniond
    {
        public double X, Y, Z, W;

        public Quaterniond(double x, double y, double z, double w)
        {
            X = x;
            Y = y;
            Z = z;
            W = w;
        }

        // Rotates a vector from the body's frame into the world's; the quaternion has length 1.
        public Vector3d Rotate(Vector3d v)
        {
            Vector3d u = new Vector3d(X, Y, Z);
            Vector3d t = 2.0 * Vector3d.Cross(u, v);
            return v + W * t + Vector3d.Cross(u, t);
        }

        public Quaterniond Inverse()
        {
            return new Quaterniond(-X, -Y, -Z, W);
        }

        // Brought to length 1, in double precision: an engine's floats are not exact enough.
        public Quaterniond Normalized()
        {
            double length = Math.Sqrt(X * X + Y * Y + Z * Z + W * W);
            return new Quaterniond(X / length, Y / length, Z / length, W / length);
        }
    }

    // What one lane is to do in a control step.
    public struct LaneCommand
    {
        public Vector3d Direction; // unit vector d
        public double Speed; // v_cmd (m/s), 0 to the plant's SpeedMax
        public double Compensation; // c, upward force as a fraction of the weight
        public long Step; // control step since the lane's reset, 1 for the first; for ForceLaw.Gust
    }

    // One lane's state. The session keeps count of steps and simulated time.
    public struct LanePose
    {
        public Vector3d Position; // centre of mass (m)
        public Quaterniond Rotation; // of length 1
        public Vector3d LinearVelocity; // of the centre of mass (m/s)
        public Vector3d AngularVelocity; // (rad/s), world frame
        public int ContactSteps; // inner steps of this control step with wall contact
    }

    // The state and the parameters that one lane is put into.
    public sealed class LaneReset
    {
        public int Lane;
        public LanePose Pose;
        public int Tube; // index of a registered tube, or Layout.NoTube
        public ulong Seed; // of the lane's gusts
        public double[] Parameters; // words by ParameterIndex
    }

    // A mesh file, how to read it, and what it must hash to; WallMesh.Read does so.
    public sealed class TubeReference
    {
        public string Path;
        public bool YUp; // the file's Y axis points up, else its Z axis
        public double Scale; // metres per unit of the file
        public byte[] Sha256;
    }

    // What a plant says of itself in the handshake.
    public sealed class PlantDescription
    {
        public string Name, Version, Engine;
        public double SpeedMax; // largest speed that a command may carry (m/s)
        public double[] Defaults; // parameters by ParameterIndex; decide how the drone flies
        public bool Walls; // registered tubes stop the body and contact with them is reported
    }

    // Whatever integrates rigid bodies behind the protocol. A method refuses what it cannot do by throwing Refusal
    // before any lane has moved; the session reports that to the agent and goes on. Any other exception ends it.
    public interface IPlant
    {
        PlantDescription Describe();

        // Prepares that many worlds which never touch each other; called once, before the session opens.
        void Open(int lanes, double dt, double physicsDt, int innerSteps);

        void RegisterTube(int index, TubeReference tube);

        void ReleaseTube(int index);

        // Puts lanes into their initial states and writes their entries of poses; nothing is integrated.
        void Reset(LaneReset[] resets, LanePose[] poses);

        // Integrates every lane over exactly innerSteps inner steps; poses hold the last states and take the new.
        void Step(LaneCommand[] commands, LanePose[] poses);

        void Close();
    }

    // The request was not carried out and nothing moved; the session goes on. Lane is -1 where none is meant.
    public sealed class Refusal : Exception
    {
        public readonly RefusalCode Code;
        public readonly int Lane;
        public readonly string Field, Expected, Found;

        public Refusal(string field, string expected, string found, int lane = -1,
            RefusalCode code = RefusalCode.Plant)
            : base(field + ": expected " + expected + ", found " + found)
        {
            Code = code;
            Lane = lane;
            Field = field;
            Expected = expected;
            Found = found;
        }
    }

    // Root of what ends a session.
    public class ProtocolException : Exception
    {
        public readonly Farewell Farewell; // what the agent is told

        public ProtocolException(Farewell farewell, string message)
            : base(message)
        {
            Farewell = farewell;
        }
    }

    // The agent's header is not what this version expects.
    public sealed class HandshakeException : ProtocolException
    {
        public HandshakeException(string field, string expected, string found)
            : base(Farewell.Handshake, field + ": expected " + expected + ", found " + found)
        {
        }
    }

    // The agent broke the protocol; the text has the agent as its subject.
    public sealed class PeerViolation : ProtocolException
    {
        public PeerViolation(string message)
            : base(Farewell.Violation, message)
        {
        }
    }

    // The agent died, left, or never came.
    public sealed class PeerLost : ProtocolException
    {
        public PeerLost(string message)
            : base(Farewell.Stopped, message)
        {
        }
    }

    // Numbers in messages, the same on a machine of any language.
    public static class Format
    {
        public static string Of(double value)
        {
            return value.ToString("R", CultureInfo.InvariantCulture);
        }

        public static string Of(long value)
        {
            return value.ToString(CultureInfo.InvariantCulture);
        }
    }
}
